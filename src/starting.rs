//! The engine as configured, on the map that it is to start from.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use thiserror::Error;

use crate::config::{Config, EngineKind};
use crate::map::{self, MapFileError};
use crate::slam::engine::Engine;
use crate::slam::gmapping::ThreadsError;
use crate::slam::known_map::KnownMap;

/// Resolutions that differ by less than this share are one: some programs write floats.
const SAME: f64 = 1e-6;

/// Why an engine cannot start.
#[derive(Debug, Error)]
pub enum StartError {
    /// Its threads do not.
    #[error(transparent)]
    Threads(#[from] ThreadsError),
    /// The map cannot be read.
    #[error("map: {source}")]
    Map {
        /// Why.
        source: MapFileError,
    },
    /// There is no map to localize in, or to search.
    #[error("{0}: a map is needed: --map, or map")]
    NoMap(&'static str),
    /// The map has other cells than the engine.
    #[error(
        "map: {}: resolution is {found} m a cell, and {key} is {wanted} m; set {key} to {found}",
        path.display()
    )]
    Resolution {
        /// The file.
        path: PathBuf,
        /// Its resolution, m.
        found: f64,
        /// The key of the engine's resolution.
        key: &'static str,
        /// Its value, m.
        wanted: f64,
    },
}

/// The engine as configured, before its first scan.
///
/// # Errors
/// When the map that it is to start from cannot be used, or its threads do not start.
pub fn engine(config: &Config, threads: usize) -> Result<Engine, StartError> {
    let parameters = config.engine_parameters();
    let mut engine = match known_map(config)? {
        Some(known) => Engine::from_map(parameters, threads, Arc::new(known))?,
        None => Engine::new(parameters, threads)?,
    };
    engine.set_mode(config.raw.mode);
    Ok(engine)
}

/// The map to start from, if one is configured.
///
/// # Errors
/// When it cannot be read, or has cells of another size than the engine.
pub fn known_map(config: &Config) -> Result<Option<KnownMap>, StartError> {
    let Some(path) = &config.raw.map else { return Ok(None) };
    let path = Path::new(path);
    let mut grid = map::read(path).map_err(|source| StartError::Map { source })?;
    let (key, wanted) = match config.raw.engine {
        EngineKind::Gmapping | EngineKind::KnownPoses => ("delta", config.raw.resolution),
        EngineKind::Hector => ("map_resolution", config.raw.map_resolution),
    };
    if (grid.resolution - wanted).abs() > SAME * wanted {
        let (path, found) = (path.to_owned(), grid.resolution);
        return Err(StartError::Resolution { path, found, key, wanted });
    }
    grid.resolution = wanted;
    Ok(Some(KnownMap::new(grid, config.occupied_threshold())))
}
