//! One version of the map in every format, each made once, when somebody asks for it.

use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use bytes::Bytes;
use serde::Serialize;
use thiserror::Error;

use super::last_seen::Sightings;
use super::selector::{MapFormat, MessageFormat, PathFormat, RegionQuestion};
use super::snapshot::MapVersion;
use crate::convert;
use crate::evaluation::{self, StampedPose};
use crate::map;
use crate::map::region::{Known, LastSeen, Layer, Region, RegionError, Window};
use crate::ros;
use crate::slam::grid::occupancy::{OccupancyGrid, OccupancyMap, OccupiedThreshold};
use crate::slam::path::Path;
use crate::slam::pose::{Point2, Pose2, Stamp};

/// What the YAML of a query calls the image; who saves it under another name edits one line.
const USUAL_IMAGE: &str = "map.pgm";

/// The newest poses of the path that are all published; of the older ones no more are. 155 kB.
const PUBLISHED_POSES: usize = 1024;

/// What a map is before there is one.
#[derive(Debug, Clone, PartialEq)]
pub struct EmptyMap {
    /// The frame that maps are in.
    pub frame: String,
    /// Metres a cell.
    pub resolution: f64,
}

/// Which map it is: what the attachment of a reply says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Label {
    /// Of the last scan in it.
    pub stamp: ros::Time,
    /// Grows with every change; 0 before the first scan.
    pub version: u64,
    /// [`map::content_hash`] of its cells, resolution and origin.
    pub sha256: String,
}

/// Why a format cannot be had.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum FormatError {
    /// There is nothing to see.
    #[error(
        "there is no map to show yet: no scan has been processed (format=cdr and format=json give \
         a map without cells)"
    )]
    NoMap,
    /// The map has a size that pictures do not have.
    #[error("the map cannot be drawn: {0}")]
    Picture(String),
    /// No such region.
    #[error(transparent)]
    Region(#[from] RegionError),
}

/// One version of the map, or the empty one, as bytes.
///
/// Who asks first for a format pays for it; the others wait and share the bytes. Nothing here
/// waits for the filter, but making a format takes milliseconds: not for tasks of the runtime.
#[derive(Debug)]
pub struct MapProducts {
    version: Option<Arc<MapVersion>>,
    last_seen: LastSeen,
    empty: EmptyMap,
    grid: OnceLock<OccupancyGrid>,
    label: OnceLock<Label>,
    cdr: OnceLock<Bytes>,
    json: OnceLock<Bytes>,
    png: OnceLock<Result<Bytes, FormatError>>,
    pgm: OnceLock<Bytes>,
    path_cdr: OnceLock<Bytes>,
    path_json: OnceLock<Bytes>,
    tum: OnceLock<Bytes>,
}

impl MapProducts {
    /// Of a version, or before the first one.
    #[must_use]
    pub const fn new(version: Option<Arc<MapVersion>>, empty: EmptyMap) -> Self {
        Self {
            version,
            last_seen: LastSeen::new(),
            empty,
            grid: OnceLock::new(),
            label: OnceLock::new(),
            cdr: OnceLock::new(),
            json: OnceLock::new(),
            png: OnceLock::new(),
            pgm: OnceLock::new(),
            path_cdr: OnceLock::new(),
            path_json: OnceLock::new(),
            tum: OnceLock::new(),
        }
    }

    /// The number of the version; 0 before the first.
    #[must_use]
    pub fn version(&self) -> u64 {
        self.version.as_ref().map_or(0, |version| version.version)
    }

    /// Whether no cell is known.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.grid().cells.is_empty()
    }

    /// The map, cropped to what is known; without cells before the first scan.
    #[must_use]
    pub fn grid(&self) -> &OccupancyGrid {
        self.grid.get_or_init(|| {
            let version = self.version.as_ref();
            let grid = version.and_then(|map| map.occupancy.to_grid(map.occupied_threshold));
            grid.unwrap_or_else(|| OccupancyGrid {
                resolution: self.empty.resolution,
                width: 0,
                height: 0,
                origin: Point2::new(0.0, 0.0),
                cells: Vec::new(),
            })
        })
    }

    /// Which map it is.
    #[must_use]
    pub fn label(&self) -> &Label {
        self.label.get_or_init(|| Label {
            stamp: convert::time(self.stamp()),
            version: self.version(),
            sha256: map::content_hash(self.grid()),
        })
    }

    /// Which map it is, as JSON.
    #[must_use]
    pub fn attachment(&self) -> Bytes {
        serde_json::to_vec(self.label()).expect("memory takes every write").into()
    }

    /// The map in a format; `robot_in_map` is for those that show the robot.
    ///
    /// # Errors
    /// When there is nothing to show, or too much for a picture.
    pub fn map(&self, format: MapFormat, robot_in_map: Pose2) -> Result<Bytes, FormatError> {
        match format {
            MapFormat::Cdr => Ok(self.cdr()),
            MapFormat::Json => Ok(self.json.get_or_init(|| map::json(self.grid()).into()).clone()),
            _ if self.is_empty() => Err(FormatError::NoMap),
            MapFormat::Png => self.png(),
            MapFormat::Pgm => Ok(self.pgm()),
            MapFormat::Yaml => Ok(self.yaml(USUAL_IMAGE)),
            MapFormat::Text { columns } => Ok(self.text(columns, robot_in_map)),
        }
    }

    /// `nav_msgs/OccupancyGrid` as CDR, which is `nav_msgs/srv/GetMap_Response` too: that has the
    /// grid as its only field.
    #[must_use]
    pub fn cdr(&self) -> Bytes {
        let encode = || ros::cdr(&convert::occupancy_grid(self.header(), self.grid())).into();
        self.cdr.get_or_init(encode).clone()
    }

    /// The picture, with the path.
    ///
    /// # Errors
    /// When the map has a size that PNG does not have.
    pub fn png(&self) -> Result<Bytes, FormatError> {
        let encode = || {
            let path: Vec<Point2> = self.path().iter().map(|(_, pose)| pose.position()).collect();
            let picture = map::png(self.grid(), &path);
            picture.map(Bytes::from).map_err(|error| FormatError::Picture(error.to_string()))
        };
        self.png.get_or_init(encode).clone()
    }

    /// A part of the map in coarser cells, as a map that can be had in all formats; `most` is how
    /// many bytes an answer may have.
    ///
    /// # Errors
    /// When its cells would be too fine or too many.
    pub fn region(&self, asked: &RegionQuestion, most: usize) -> Result<Self, FormatError> {
        let region = self.cells_of(asked)?;
        region.check_size(1, most)?;
        let (map, threshold) = self.counted();
        let grid = region.occupancy(map, threshold);
        let part = Self::new(self.version.clone(), self.empty.clone());
        Ok(Self { grid: OnceLock::from(grid), ..part })
    }

    /// Layers of a part of the map, as JSON of at most so many bytes.
    ///
    /// # Errors
    /// When its cells would be too fine or too many.
    pub fn layers(
        &self,
        asked: &RegionQuestion,
        layers: &[Layer],
        most: usize,
    ) -> Result<Bytes, FormatError> {
        let known = self.version.as_ref().map(|version| Known {
            map: &version.occupancy,
            threshold: version.occupied_threshold,
            last_seen: &self.last_seen,
        });
        let region = self.cells_of(asked)?;
        region.check_size(layers.len(), most)?;
        Ok(region.json(layers, known, most)?.into())
    }

    fn counted(&self) -> (Option<&OccupancyMap>, OccupiedThreshold) {
        let version = self.version.as_ref();
        let nothing = (None, OccupiedThreshold::of_share(0.0));
        version.map_or(nothing, |map| (Some(&map.occupancy), map.occupied_threshold))
    }

    fn cells_of(&self, asked: &RegionQuestion) -> Result<Region, FormatError> {
        let resolution = self.counted().0.map_or(self.empty.resolution, OccupancyMap::resolution);
        let window = asked.window.unwrap_or_else(|| {
            let OccupancyGrid { resolution, width, height, origin, .. } = self.grid();
            let [x, y] = [*width, *height].map(|cells| cells as f64 * resolution);
            Window { low: *origin, high: Point2::new(origin.x + x, origin.y + y) }
        });
        Ok(Region::new(window, asked.resolution.unwrap_or(resolution), resolution)?)
    }

    /// The image of map_server.
    #[must_use]
    pub fn pgm(&self) -> Bytes {
        self.pgm.get_or_init(|| map::pgm(self.grid()).into()).clone()
    }

    /// The file that goes with the image of map_server.
    #[must_use]
    pub fn yaml(&self, image: &str) -> Bytes {
        map::yaml(self.grid(), image).into()
    }

    fn text(&self, columns: NonZeroUsize, robot_in_map: Pose2) -> Bytes {
        map::text(self.grid(), columns, Some(robot_in_map)).into()
    }

    /// `nav_msgs/MapMetaData`.
    #[must_use]
    pub fn metadata(&self) -> ros::MapMetaData {
        convert::map_meta_data(convert::time(self.stamp()), self.grid())
    }

    /// The pose of the base at each processed scan in this map.
    #[must_use]
    pub fn path_in(&self, format: PathFormat) -> Bytes {
        let message = || self.path_message(self.path().iter());
        match format {
            PathFormat::Message(MessageFormat::Cdr) => {
                self.path_cdr.get_or_init(|| ros::cdr(&message()).into()).clone()
            }
            PathFormat::Message(MessageFormat::Json) => {
                self.path_json.get_or_init(|| ros::json(&message()).into()).clone()
            }
            PathFormat::Tum => self.tum(),
        }
    }

    /// The path with a line a pose.
    #[must_use]
    pub fn tum(&self) -> Bytes {
        let encode = || {
            let path = self.path();
            let poses: Vec<StampedPose> =
                path.iter().map(|(stamp, pose)| StampedPose { stamp, pose }).collect();
            evaluation::tum(&poses).into()
        };
        self.tum.get_or_init(encode).clone()
    }

    /// The path as it is published: what it costs does not grow for ever.
    #[must_use]
    pub fn path_excerpt(&self) -> Bytes {
        ros::cdr(&self.path_message(self.path().excerpt(PUBLISHED_POSES))).into()
    }

    fn path_message(&self, poses: impl Iterator<Item = (Stamp, Pose2)>) -> ros::Path {
        let poses: Vec<(Stamp, Pose2)> = poses.collect();
        convert::path(self.header(), &poses)
    }

    fn path(&self) -> Path {
        self.version.as_ref().map(|version| version.path.clone()).unwrap_or_default()
    }

    fn header(&self) -> ros::Header {
        convert::header(self.stamp(), &self.empty.frame)
    }

    fn stamp(&self) -> Stamp {
        self.version.as_ref().map(|version| version.stamp).unwrap_or_default()
    }
}

/// The products of the newest version, shared by all who publish and answer.
#[derive(Debug)]
pub struct ProductCache {
    empty: EmptyMap,
    newest: Mutex<(Arc<MapProducts>, Sightings)>,
    asked: AtomicBool,
}

impl ProductCache {
    /// Nothing made yet.
    #[must_use]
    pub fn new(empty: EmptyMap) -> Self {
        let first = MapProducts::new(None, empty.clone());
        Self {
            empty,
            newest: Mutex::new((Arc::new(first), Sightings::default())),
            asked: AtomicBool::new(false),
        }
    }

    /// Notes that somebody has asked for the map.
    pub fn note_asked(&self) {
        self.asked.store(true, Ordering::Relaxed);
    }

    /// Makes a new version ready for the next who asks, if somebody asked for the one before.
    pub fn make_ready(&self, version: &Arc<MapVersion>) {
        let products = self.of(Some(version));
        if self.asked.swap(false, Ordering::Relaxed) {
            let _ready = (products.cdr(), products.label());
        }
    }

    /// The products of this version; those of another are forgotten once nobody uses them.
    #[must_use]
    pub fn of(&self, version: Option<&Arc<MapVersion>>) -> Arc<MapProducts> {
        let mut newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        let (products, sightings) = &mut *newest;
        if products.version() != version.map_or(0, |version| version.version) {
            let last_seen = sightings.update(version);
            let made = MapProducts::new(version.cloned(), self.empty.clone());
            *products = Arc::new(MapProducts { last_seen, ..made });
        }
        products.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::grid::occupancy::{BeamEnd, BeamEndKind, ScanOutline};

    fn empty() -> EmptyMap {
        EmptyMap { frame: "map".to_owned(), resolution: 0.05 }
    }

    /// A map of one wall that a robot at the origin sees.
    fn version(number: u64) -> Arc<MapVersion> {
        let mut occupancy = OccupancyMap::new(0.1);
        let end = |y| BeamEnd { point: [2.0, y], kind: BeamEndKind::Hit };
        let ends = (-8..=8).map(|step| end(step as f32 * 0.1)).collect();
        let outline = ScanOutline { sensor: Point2::new(0.0, 0.0), ends, angle_increment: 0.05 };
        occupancy.add(&outline, Pose2::IDENTITY);
        let path = [(Stamp(1_000_000_000), Pose2::IDENTITY)];
        Arc::new(MapVersion {
            version: number,
            epoch: 1,
            stamp: Stamp(2_500_000_000),
            occupancy,
            occupied_threshold: OccupiedThreshold::of_share(0.25),
            path: path.into_iter().collect(),
        })
    }

    fn products() -> MapProducts {
        MapProducts::new(Some(version(7)), empty())
    }

    #[test]
    fn a_version_is_made_ready_once_somebody_asked_for_one() {
        let cache = ProductCache::new(empty());
        let made = |number| {
            let version = version(number);
            cache.make_ready(&version);
            cache.of(Some(&version)).cdr.get().is_some()
        };
        assert!(!made(1));
        cache.note_asked();
        assert!(made(2));
        assert!(!made(3), "nobody asked for version 2");
    }

    #[test]
    fn the_response_of_the_service_has_the_bytes_of_the_grid() {
        let products = products();
        let map = ros::decode::<ros::OccupancyGrid>(&products.cdr(), "").unwrap();
        assert_eq!((map.header.frame_id.as_str(), map.info.resolution), ("map", 0.1));
        assert_eq!(products.cdr(), ros::cdr(&ros::GetMapResponse { map }));
    }

    #[test]
    fn every_format_is_made_once() {
        let products = products();
        let formats = [MapFormat::Cdr, MapFormat::Json, MapFormat::Png, MapFormat::Pgm];
        for format in formats {
            let bytes = || products.map(format, Pose2::IDENTITY).unwrap();
            assert_eq!(bytes().as_ptr(), bytes().as_ptr(), "{format:?}");
        }
        for format in [
            PathFormat::Message(MessageFormat::Cdr),
            PathFormat::Message(MessageFormat::Json),
            PathFormat::Tum,
        ] {
            let bytes = || products.path_in(format);
            assert_eq!(bytes().as_ptr(), bytes().as_ptr(), "{format:?}");
        }
    }

    #[test]
    fn the_attachment_tells_stamp_version_and_content() {
        let products = products();
        let hash = map::content_hash(products.grid());
        let expected =
            format!(r#"{{"stamp":{{"sec":2,"nanosec":500000000}},"version":7,"sha256":"{hash}"}}"#);
        assert_eq!(products.attachment(), expected);
    }

    #[test]
    fn before_the_first_scan_the_map_has_no_cells_and_no_picture() {
        let products = MapProducts::new(None, empty());
        let map = ros::decode::<ros::OccupancyGrid>(&products.cdr(), "").unwrap();
        assert_eq!((map.info.width, map.info.height, map.info.resolution), (0, 0, 0.05));
        assert_eq!(map.header.frame_id, "map");
        let json = products.map(MapFormat::Json, Pose2::IDENTITY).unwrap();
        assert!(json.ends_with(br#""runs":[]}"#));
        let columns = NonZeroUsize::new(80).unwrap();
        let shown = [MapFormat::Png, MapFormat::Pgm, MapFormat::Yaml, MapFormat::Text { columns }];
        for format in shown {
            let error = products.map(format, Pose2::IDENTITY).unwrap_err();
            assert_eq!(error, FormatError::NoMap, "{format:?}");
        }
        assert_eq!(products.tum(), "");
    }

    #[test]
    fn the_cache_keeps_the_products_of_one_version() {
        let cache = ProductCache::new(empty());
        let (first, second) = (version(1), version(2));
        assert!(Arc::ptr_eq(&cache.of(None), &cache.of(None)));
        let products = cache.of(Some(&first));
        assert_eq!(products.version(), 1);
        assert!(Arc::ptr_eq(&products, &cache.of(Some(&first))));
        assert_eq!(cache.of(Some(&second)).version(), 2);
        assert_eq!(Arc::strong_count(&products), 1, "the cache let go of it");
        assert_eq!(cache.of(None).version(), 0);
    }
}
