//! `gmapd save`: a robot's map to files on this machine, as map_saver does.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};
use clap::Args;
use gmapd::files::write_atomically;
use gmapd::map;
use gmapd::slam::grid::occupancy::OccupancyGrid;

use super::mesh;
use super::session::SessionArguments;

/// Whose map, and where it goes.
#[derive(Debug, Args)]
#[command(after_help = "\
    Writes NAME.pgm and NAME.yaml on this machine; nav2's map_server loads them.\n\
    To have the robot write on its own disk, ask its daemon: slam/cmd/save?name=NAME.\n\n\
    Examples:\n  \
        gmapd save -f office\n  \
        gmapd save robot01 -f maps/office -e tcp/192.168.1.5:7447")]
pub(crate) struct Arguments {
    /// Whose map: what the robot's keys begin with; without, the only robot that is alive
    robot: Option<String>,
    /// Name of the files, without ending
    #[arg(short = 'f', long = "file", value_name = "NAME")]
    name: PathBuf,
    #[command(flatten)]
    session: SessionArguments,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let answer = mesh::block_on(async {
        let session = arguments.session.open().await?;
        let robot = mesh::choose(&session, arguments.robot.as_deref()).await?;
        // One answer holds cells, resolution and origin of one and the same map.
        let answer = mesh::ask_robot(&session, &robot, ("map", "format=json")).await?;
        session.close().await.ok();
        Ok(answer)
    })?;
    let grid = map::parse_json(&answer.bytes).context("cannot read the answer")?;
    ensure!(!grid.cells.is_empty(), "there is no map yet");
    for path in write(&arguments.name, &grid)? {
        println!("wrote {}", path.display());
    }
    Ok(())
}

/// The picture first, so that there is never a YAML file without it.
fn write(name: &Path, grid: &OccupancyGrid) -> anyhow::Result<[PathBuf; 2]> {
    let [pgm, yaml] = ["pgm", "yaml"].map(|ending| with_ending(name, ending));
    let image = pgm.file_name().context("the name of the files is empty")?.to_string_lossy();
    write_atomically(&pgm, &map::pgm(grid))?;
    write_atomically(&yaml, map::yaml(grid, &image).as_bytes())?;
    Ok([pgm, yaml])
}

/// `floor.2` becomes `floor.2.pgm`.
fn with_ending(name: &Path, ending: &str) -> PathBuf {
    let mut name: OsString = name.into();
    name.push(".");
    name.push(ending);
    name.into()
}

#[cfg(test)]
mod tests {
    use gmapd::slam::pose::Point2;

    use super::*;

    #[test]
    fn the_yaml_names_the_picture_beside_it() {
        let directory = tempfile::tempdir().unwrap();
        let origin = Point2::new(0.0, 0.0);
        let grid =
            OccupancyGrid { resolution: 0.05, width: 2, height: 1, origin, cells: vec![0, 100] };
        let [pgm, yaml] = write(&directory.path().join("floor.2"), &grid).unwrap();
        assert!(pgm.ends_with("floor.2.pgm"));
        assert_eq!(std::fs::read(pgm).unwrap(), map::pgm(&grid));
        let yaml = std::fs::read_to_string(yaml).unwrap();
        assert!(yaml.starts_with("image: floor.2.pgm\n"), "{yaml}");
    }
}
