//! `gmapd simulate`: a recorded run through a made-up world, with the truth.

use std::io;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::{Args, ValueEnum};

use gmapd::evaluation::{self, StampedPose};
use gmapd::files::{NewFile, write_atomically};
use gmapd::logs::carmen_writer::CarmenWriter;
use gmapd::sim::{Place, Reading, Scenario, Simulation};

/// Simulate a robot with a laser and write what it records as a CARMEN log.
#[derive(Debug, Args)]
pub(crate) struct SimulateArgs {
    /// Where the robot drives
    #[arg(long, value_enum, default_value = "building")]
    scenario: ScenarioName,
    /// Seed of the world and of all errors; the same seed gives the same files
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// How often the robot drives its lap
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1000))]
    laps: u32,
    /// Number of people walking about
    #[arg(long, value_name = "N", default_value_t = 0)]
    people: usize,
    /// Beams of the laser, all around
    #[arg(long, value_name = "N", default_value_t = 360)]
    beams: usize,
    /// Share of the beams that return from where nothing is
    #[arg(long, value_name = "SHARE", default_value_t = 0.007, value_parser = share)]
    outlier_rate: f64,
    /// Odometry readings a scan
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=1000))]
    odometry_per_scan: u32,
    /// The log to write
    #[arg(long, value_name = "LOG", default_value = "sim.log")]
    out: PathBuf,
    /// Where to write the true poses, in the TUM format [default: LOG with .truth.tum]
    #[arg(long, value_name = "FILE.tum")]
    truth: Option<PathBuf>,
}

/// The names of the places.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum ScenarioName {
    /// Offices of 40 m by 40 m, a tour of about 400 m a lap
    Building,
    /// A ring corridor of 260 m with little to see
    Ring,
    /// A straight corridor of 60 m with nothing to see
    Corridor,
}

/// Writes the log and the truth, and says what to do with them.
///
/// # Errors
/// When the scenario cannot be simulated or a file cannot be written.
pub(crate) fn run(args: &SimulateArgs) -> anyhow::Result<()> {
    let simulation = simulation(args)?;
    let SimulateArgs { out, beams, .. } = args;
    let truth = args.truth.clone().unwrap_or_else(|| out.with_extension("truth.tum"));
    let readings = write_files(&simulation, out, &truth)?;
    println!(
        "{}: {:.1} m in {:.1} s, {} readings, {} of them scans of {} beams",
        out.display(),
        simulation.trajectory.length_m(),
        simulation.trajectory.duration_s(),
        readings,
        simulation.scan_count(),
        beams,
    );
    println!("{}: the true pose at each scan", truth.display());
    println!("next: gmapd replay {} --out out", out.display());
    Ok(())
}

fn simulation(args: &SimulateArgs) -> anyhow::Result<Simulation> {
    let place = match args.scenario {
        ScenarioName::Building => Place::Building,
        ScenarioName::Ring => Place::Ring,
        ScenarioName::Corridor => Place::Corridor,
    };
    let (laps, people, beams) = (args.laps, args.people, args.beams);
    let scenario = Scenario { place, seed: args.seed, laps, people, beams };
    let mut simulation = Simulation::new(&scenario)
        .with_context(|| format!("a laser with --beams {beams} cannot be simulated"))?;
    simulation.lidar.outlier_rate = args.outlier_rate;
    Ok(Simulation { odometry_per_scan: args.odometry_per_scan, ..simulation })
}

fn share(text: &str) -> Result<f64, String> {
    let share = text.parse::<f64>().map_err(|error| error.to_string())?;
    if (0.0..=1.0).contains(&share) { Ok(share) } else { Err("not from 0 to 1".to_owned()) }
}

/// Writes both files and returns the number of readings in the log.
fn write_files(simulation: &Simulation, log: &Path, truth: &Path) -> anyhow::Result<usize> {
    let mut log = NewFile::create(log)?;
    let readings = write_log(simulation, &mut log).map_err(|source| log.error(source))?;
    let poses = simulation
        .readings()
        .map(|reading| StampedPose { stamp: reading.stamp, pose: reading.world_from_base });
    write_atomically(truth, evaluation::tum(&poses.collect::<Vec<_>>()).as_bytes())?;
    log.publish()?;
    Ok(readings)
}

fn write_log(simulation: &Simulation, log: &mut NewFile) -> io::Result<usize> {
    let mut carmen = CarmenWriter::new(log, simulation.lidar.mount);
    let mut readings = 0;
    for Reading { odometry_between, scan, odom_from_base, .. } in simulation.readings() {
        readings += odometry_between.len() + 1;
        for (stamp, odom_from_base) in odometry_between {
            carmen.write_odometry(stamp, odom_from_base)?;
        }
        carmen.write_scan(&scan, odom_from_base)?;
    }
    Ok(readings)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn args(directory: &Path, name: &str, seed: u64) -> SimulateArgs {
        SimulateArgs {
            scenario: ScenarioName::Corridor,
            seed,
            laps: 1,
            people: 1,
            beams: 8,
            outlier_rate: 0.007,
            odometry_per_scan: 2,
            out: directory.join(name),
            truth: None,
        }
    }

    #[test]
    fn the_same_seed_writes_the_same_files_and_nothing_else() {
        let directory = tempfile::tempdir().unwrap();
        for (name, seed) in [("a.log", 1), ("b.log", 1), ("c.log", 2)] {
            run(&args(directory.path(), name, seed)).unwrap();
        }
        let read = |name: &str| fs::read_to_string(directory.path().join(name)).unwrap();
        assert_eq!(read("a.log"), read("b.log"));
        assert_eq!(read("a.truth.tum"), read("b.truth.tum"));
        assert_ne!(read("a.log"), read("c.log"));
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 6);
        let count =
            |keyword: &str| read("a.log").lines().filter(|l| l.starts_with(keyword)).count();
        assert_eq!(count("ROBOTLASER1 "), read("a.truth.tum").lines().count());
        assert_eq!(count("ODOM "), count("ROBOTLASER1 ") - 1);
    }

    #[test]
    fn errors_name_the_option_or_the_file() {
        let directory = tempfile::tempdir().unwrap();
        let too_few = SimulateArgs { beams: 1, ..args(directory.path(), "a.log", 1) };
        assert!(run(&too_few).unwrap_err().to_string().contains("--beams 1"));
        let nowhere = args(&directory.path().join("missing"), "a.log", 1);
        assert!(run(&nowhere).unwrap_err().to_string().ends_with("missing/a.log"));
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 0);
    }
}
