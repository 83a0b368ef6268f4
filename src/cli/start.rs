//! Arguments about where mapping starts, for all who map.

use clap::Args;

/// The map to start from, and where in it.
#[derive(Debug, Args)]
pub(super) struct StartArguments {
    /// Map to start from: the YAML file of a PGM; the same as --set map=FILE
    #[arg(long, value_name = "FILE")]
    map: Option<String>,
    /// Pose of the base at the first scan, m, m and rad, or search: where it fits in the map.
    /// With --map and no pose, it is searched for; with --state it is where the robot is now. The
    /// same as --set initial_pose=[X,Y,YAW]
    #[arg(long, value_name = "X,Y,YAW|search", allow_hyphen_values = true)]
    initial_pose: Option<String>,
    /// mapping, or localization, which leaves the map as it is; the same as --set mode=MODE
    #[arg(long, value_name = "MODE")]
    mode: Option<String>,
}

impl StartArguments {
    /// The same as `--set` has it.
    pub(super) fn overrides(&self) -> Vec<String> {
        // A JSON string is a YAML string, whatever is in it.
        let map = self.map.as_ref().map(|map| format!("map={}", serde_json::Value::from(&**map)));
        let pose = self.initial_pose.as_ref().map(|pose| match pose.contains(',') {
            true => format!("initial_pose=[{pose}]"),
            false => format!("initial_pose={pose}"),
        });
        let mode = self.mode.as_ref().map(|mode| format!("mode={mode}"));
        map.into_iter().chain(pose).chain(mode).collect()
    }
}
