//! `gmapd evaluate`: the relation metric.

use std::io::Write as _;
use std::path::PathBuf;

use anyhow::ensure;
use clap::Args;
use gmapd::evaluation::{
    ErrorStatistics, RelationReport, read_relations, read_trajectory, relation_errors,
};

/// Skipped relations that are listed one by one.
const SKIPPED_SHOWN: usize = 5;

/// What to compare.
#[derive(Debug, Args)]
#[command(after_help = "\
    For each relation the error is relation⁻¹ · (pose(t1)⁻¹ · pose(t2)).\n\
    Poses are found by stamp, within 10 microseconds; relations without are skipped and listed.\n\n\
    Examples:\n  \
        gmapd evaluate out/trajectory.tum intel.relations\n  \
        gmapd evaluate gmapping.txt intel.relations --json")]
pub(crate) struct Arguments {
    /// Trajectory: TUM's format, or lines of "stamp x y theta"
    trajectory: PathBuf,
    /// Relations: lines of "t1 t2 x y z roll pitch yaw", the pose at t2 seen from the pose at t1
    relations: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let trajectory = read_trajectory(&arguments.trajectory)?;
    let relations = read_relations(&arguments.relations)?;
    let report = relation_errors(&trajectory, &relations);
    let mut out = std::io::stdout().lock();
    if arguments.json {
        writeln!(out, "{}", serde_json::to_string_pretty(&report)?)?;
    } else {
        write!(out, "{}", readable(&report))?;
    }
    ensure!(
        report.used > 0,
        "no relation of {} has both its stamps in {}",
        arguments.relations.display(),
        arguments.trajectory.display()
    );
    Ok(())
}

fn readable(report: &RelationReport) -> String {
    let mut text = format!("relations    {} used, {} skipped\n", report.used, report.skipped.len());
    let errors =
        [("translation", report.translation_m, "m"), ("rotation", report.rotation_deg, "degrees")];
    for (name, statistics, unit) in errors {
        let Some(ErrorStatistics { mean, std, p95, max }) = statistics else { continue };
        text += &format!(
            "{name:<12} mean {mean:.4}  std {std:.4}  p95 {p95:.4}  max {max:.4} {unit}\n"
        );
    }
    for skipped in report.skipped.iter().take(SKIPPED_SHOWN) {
        let nearest =
            skipped.nearest_s.map_or(String::new(), |s| format!(", nearest {s:.6} s off"));
        text += &format!(
            "skipped      line {}: no pose at {:.6}{nearest}\n",
            skipped.line, skipped.stamp_s
        );
    }
    if report.skipped.len() > SKIPPED_SHOWN {
        text += &format!("             and {} more\n", report.skipped.len() - SKIPPED_SHOWN);
    }
    text
}
