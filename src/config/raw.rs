//! The configuration file: every key with its default, as slam_gmapping names it.

use serde::{Deserialize, Serialize};

use crate::slam::{gmapping::Parameters, hector, known_map::Mode, pose::Pose2};

/// All keys of the file. A key that is left out has slam_gmapping's default.
///
/// Keys of slam_gmapping keep their names, so that its parameter files load as they are.
/// Keys of our own carry their unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RawConfig {
    /// Which system maps.
    pub engine: EngineKind,
    /// Whether scans enter the map.
    pub mode: Mode,
    /// YAML file of a map to start from; left out, nothing is known.
    pub map: Option<String>,
    /// Known poses: what the map is of.
    pub map_of: MapOf,
    /// Number of hypotheses.
    pub particles: usize,
    /// Every n-th scan is looked at.
    pub throttle_scans: usize,

    /// Frame of the robot.
    pub base_frame: String,
    /// Frame of the map.
    pub map_frame: String,
    /// Frame of odometry.
    pub odom_frame: String,
    /// Seconds between two maps that are handed out, by the stamps of scans.
    pub map_update_interval: f64,
    /// Seconds between two sendings of `map` to `odom`; 0 is off.
    pub transform_publish_period: f64,
    /// Seconds by which `map` to `odom` is dated ahead; left out, `transform_publish_period`.
    pub tf_delay: Option<f64>,
    /// What every key of the robot begins with, such as `robot01`; may be empty.
    pub prefix: String,
    /// The inputs' keys under the prefix.
    pub keys: Keys,
    /// How ROS 2 nodes are met.
    pub interop: Interop,
    /// The domain of ROS 2 nodes on `rmw_zenoh`.
    pub ros_domain_id: u32,
    /// The distribution of ROS 2 nodes on `rmw_zenoh`.
    pub ros_distro: RosDistro,
    /// Where odometry comes from.
    pub odometry_source: OdometrySource,
    /// Seconds that a scan waits for its odometry.
    pub odometry_timeout_s: f64,
    /// Scans that may wait.
    pub scan_queue: usize,
    /// Directory that maps are saved in.
    pub save_directory: String,
    /// Name under which the map is saved when the daemon ends; left out, it is not.
    pub save_on_exit: Option<String>,
    /// Commands that the mesh may give.
    pub commands: Vec<CommandName>,
    /// Commands that are done in a second.
    pub commands_per_second: u32,
    /// Queries that are answered at once.
    pub queries_at_once: usize,
    /// Bytes of a message above which it is not read.
    pub max_message_bytes: usize,
    /// Bytes of an answer above which it is refused.
    pub max_reply_bytes: usize,
    /// Bytes of answers that are on their way together.
    pub max_bytes_in_flight: usize,
    /// File to which inputs and outputs are recorded, MCAP; left out, they are not.
    pub record: Option<String>,
    /// Directory that the state is kept in, to go on from after a restart; left out, it is not kept.
    pub state_directory: Option<String>,
    /// How often the state is written there.
    pub checkpoint: Checkpoint,

    /// Readings strictly above are discarded, m; left out, the sensor's own limit.
    #[serde(rename = "maxRange")]
    pub max_range: Option<f64>,
    /// Readings above are not matched and free space ends there, m; left out, `maxRange`.
    #[serde(rename = "maxUrange")]
    pub max_usable_range: Option<f64>,
    /// Seconds from the first beam of a sweep to the last; left out, as the scans say; 0, all at
    /// once.
    pub sweep_time_s: Option<f64>,
    /// Beams passed over between two that are matched.
    #[serde(rename = "lskip")]
    pub beam_skip: usize,

    /// Translation noise per metre travelled, m/m.
    #[serde(rename = "srr")]
    pub translation_noise_from_translation: f64,
    /// Rotation noise per metre travelled, rad/m.
    #[serde(rename = "srt")]
    pub rotation_noise_from_translation: f64,
    /// Translation noise per radian turned, m/rad.
    #[serde(rename = "str")]
    pub translation_noise_from_rotation: f64,
    /// Rotation noise per radian turned, rad/rad.
    #[serde(rename = "stt")]
    pub rotation_noise_from_rotation: f64,

    /// Metres travelled after which a scan is processed.
    #[serde(rename = "linearUpdate")]
    pub linear_update: f64,
    /// Radians turned after which a scan is processed.
    #[serde(rename = "angularUpdate")]
    pub angular_update: f64,
    /// Seconds after which a scan is processed; negative is off.
    #[serde(rename = "temporalUpdate")]
    pub temporal_update: f64,

    /// Which scan matcher runs.
    pub matcher: Matcher,
    /// First step of the hill climb, m.
    #[serde(rename = "lstep")]
    pub linear_step: f64,
    /// First step of the hill climb, rad.
    #[serde(rename = "astep")]
    pub angular_step: f64,
    /// A match counts only above this score.
    #[serde(rename = "minimumScore")]
    pub minimum_score: f64,
    /// Standard deviation of the likelihood field around a hit, m.
    pub field_sigma_m: f64,
    /// Compat matcher: a beam scores exp(-d²/sigma), m².
    pub sigma: f64,
    /// Compat matcher: cells searched around an endpoint.
    #[serde(rename = "kernelSize")]
    pub kernel_size: u32,
    /// Compat matcher: a beam's log likelihood is -d²/lsigma, m².
    #[serde(rename = "lsigma")]
    pub likelihood_sigma: f64,
    /// Compat matcher: how often the steps are halved.
    pub iterations: u32,

    /// Flattens weights.
    #[serde(rename = "ogain")]
    pub gain: f64,
    /// Whether weights are flattened with the number of particles.
    pub weight_smoothing: Smoothing,
    /// Resample below this fraction of effective particles.
    #[serde(rename = "resampleThreshold")]
    pub resample_threshold: f64,
    /// Seed of all random numbers.
    pub seed: u64,

    /// Metres between two odometry readings that count as a jump.
    pub jump_max_step_m: f64,
    /// What happens at a jump.
    pub jump_policy: Jump,
    /// Pose of the base in `map` at the first scan: m, m, rad; left out, odometry's, or searched
    /// for in the map to start from.
    pub initial_pose: Option<InitialPose>,
    /// How the laser sits on the robot; left out, what the log or the transforms say.
    pub laser: Option<Laser>,

    /// Metres a cell.
    #[serde(rename = "delta")]
    pub resolution: f64,
    /// A cell is occupied when hits / visits is above this.
    #[serde(rename = "occ_thresh")]
    pub occupied_threshold: f64,
    /// A cell that fewer scans saw is not occupied but unknown; left out, 2 for `known_poses` and
    /// all scans, else 1.
    #[serde(rename = "occ_min_visits")]
    pub occupied_min_visits: Option<u32>,
    /// Whether a beam without return marks free space out to `maxUrange`.
    pub free_on_no_return: bool,

    /// Hector: metres a cell of the finest map.
    pub map_resolution: f64,
    /// Hector: how many maps, each with cells twice as large as the one before.
    pub map_multi_res_levels: usize,
    /// Hector: how likely a cell that a beam passed is occupied.
    pub update_factor_free: f64,
    /// Hector: how likely a cell that a beam ended in is occupied.
    pub update_factor_occupied: f64,
    /// Hector: metres after which a scan enters the map.
    pub map_update_distance_thresh: f64,
    /// Hector: radians after which a scan enters the map.
    pub map_update_angle_thresh: f64,
    /// Hector: shorter readings say nothing, m.
    pub laser_min_dist: f64,
    /// Hector: longer readings are not matched, and free space ends there, m.
    pub laser_max_dist: f64,

    /// Without effect: the map grows without limit.
    pub xmin: f64,
    /// Without effect: the map grows without limit.
    pub ymin: f64,
    /// Without effect: the map grows without limit.
    pub xmax: f64,
    /// Without effect: the map grows without limit.
    pub ymax: f64,
    /// Never had an effect.
    pub llsamplerange: f64,
    /// Never had an effect.
    pub llsamplestep: f64,
    /// Never had an effect.
    pub lasamplerange: f64,
    /// Never had an effect.
    pub lasamplestep: f64,
}

/// Keys whose values slam_gmapping reads and never uses.
pub(super) const DEAD_KEYS: [&str; 4] =
    ["llsamplerange", "llsamplestep", "lasamplerange", "lasamplestep"];

/// Keys of hector_mapping that mean nothing here, and what takes their place.
pub(super) const HECTOR_KEYS: [(&str, &str); 27] = [
    ("map_size", "the map grows without limit"),
    ("map_start_x", "the map grows without limit"),
    ("map_start_y", "the map grows without limit"),
    ("laser_z_min_value", "a laser that is not level is refused"),
    ("laser_z_max_value", "a laser that is not level is refused"),
    ("pub_drawings", "nothing is drawn"),
    ("pub_debug_output", "there is no such output"),
    ("pub_map_odom_transform", "transform_publish_period: 0 turns it off"),
    ("pub_map_scanmatch_transform", "there is no such frame"),
    ("tf_map_scanmatch_transform_frame_name", "there is no such frame"),
    ("pub_odometry", "the pose is published"),
    ("advertise_map_service", "the map is always answered"),
    ("scan_subscriber_queue_size", "scan_queue takes its place"),
    ("scan_topic", "keys takes its place"),
    ("sys_msg_topic", "slam/cmd/reset takes its place"),
    ("pose_update_topic", "the pose is published on pose"),
    ("use_tf_scan_transformation", "the laser's mount is always used"),
    ("use_tf_pose_start_estimate", "odometry is used where there is some"),
    ("map_with_known_poses", "it is an engine of its own"),
    ("output_timing", "the status tells it"),
    ("map_pub_period", "map_update_interval takes its place"),
    ("trajectory_update_rate", "the path has each scan"),
    ("trajectory_publish_rate", "the path is published with the map"),
    ("target_frame_name", "map_frame takes its place"),
    ("source_frame_name", "base_frame takes its place"),
    ("tf_prefix", "prefix takes its place"),
    ("advertise_map_topic", "the map is always published"),
];

/// Keys of Hector, which GMapping does not look at.
pub(super) const HECTOR_ONLY: [&str; 8] = [
    "map_resolution",
    "map_multi_res_levels",
    "update_factor_free",
    "update_factor_occupied",
    "map_update_distance_thresh",
    "map_update_angle_thresh",
    "laser_min_dist",
    "laser_max_dist",
];

/// Keys of GMapping that have another name and another default with Hector.
pub(super) const GMAPPING_ONLY: [(&str, &str); 5] = [
    ("linearUpdate", "map_update_distance_thresh"),
    ("angularUpdate", "map_update_angle_thresh"),
    ("maxRange", "laser_max_dist"),
    ("maxUrange", "laser_max_dist"),
    ("delta", "map_resolution"),
];

/// Keys that size the original's first map.
pub(super) const EXTENT_KEYS: [&str; 4] = ["xmin", "ymin", "xmax", "ymax"];

/// Keys that the state does not depend on: how the mesh and files are met, and what is handed out.
pub(super) const WITHOUT_EFFECT_ON_STATE: [&str; 24] = [
    "map_update_interval",
    "transform_publish_period",
    "tf_delay",
    "prefix",
    "keys",
    "interop",
    "ros_domain_id",
    "ros_distro",
    "odometry_timeout_s",
    "scan_queue",
    "save_directory",
    "save_on_exit",
    "record",
    "state_directory",
    "checkpoint",
    "commands",
    "commands_per_second",
    "queries_at_once",
    "max_message_bytes",
    "max_reply_bytes",
    "max_bytes_in_flight",
    "engine",
    "occ_thresh",
    "occ_min_visits",
];

/// Keys that only the compat matcher looks at.
pub(super) const COMPAT_KEYS: [&str; 4] = ["sigma", "kernelSize", "lsigma", "iterations"];

impl Default for RawConfig {
    #[expect(clippy::too_many_lines, reason = "one line a key")]
    fn default() -> Self {
        let core = Parameters::default();
        let hector = hector::Parameters::default();
        Self {
            engine: EngineKind::Gmapping,
            mode: Mode::Mapping,
            map: None,
            map_of: MapOf::AllScans,
            sweep_time_s: None,
            particles: core.particles,
            throttle_scans: core.throttle_scans,
            base_frame: "base_link".to_owned(),
            map_frame: "map".to_owned(),
            odom_frame: "odom".to_owned(),
            map_update_interval: 5.0,
            transform_publish_period: 0.05,
            tf_delay: None,
            prefix: String::new(),
            keys: Keys::default(),
            interop: Interop::Bridge,
            ros_domain_id: 0,
            ros_distro: RosDistro::Jazzy,
            odometry_source: OdometrySource::Auto,
            odometry_timeout_s: 0.5,
            scan_queue: 32,
            save_directory: "maps".to_owned(),
            save_on_exit: None,
            commands: CommandName::ALL.to_vec(),
            commands_per_second: 10,
            queries_at_once: 64,
            max_message_bytes: 4 << 20,
            max_reply_bytes: 64 << 20,
            max_bytes_in_flight: 256 << 20,
            record: None,
            state_directory: None,
            checkpoint: Checkpoint::default(),
            max_range: core.max_range,
            max_usable_range: core.max_usable_range,
            beam_skip: core.matcher.beam_skip,
            translation_noise_from_translation: core.motion_noise.translation_from_translation,
            rotation_noise_from_translation: core.motion_noise.rotation_from_translation,
            translation_noise_from_rotation: core.motion_noise.translation_from_rotation,
            rotation_noise_from_rotation: core.motion_noise.rotation_from_rotation,
            linear_update: core.gate.linear_update,
            angular_update: core.gate.angular_update,
            temporal_update: core.gate.temporal_update.unwrap_or(-1.0),
            matcher: Matcher::Field,
            linear_step: core.matcher.linear_step,
            angular_step: core.matcher.angular_step,
            minimum_score: core.matcher.minimum_score,
            field_sigma_m: core.matcher.field_sigma,
            sigma: core.matcher.sigma,
            kernel_size: core.matcher.kernel_size,
            likelihood_sigma: core.matcher.likelihood_sigma,
            iterations: core.matcher.iterations,
            gain: core.weighting.flatness,
            weight_smoothing: Smoothing::Fixed,
            resample_threshold: core.weighting.resample_threshold,
            seed: 1,
            jump_max_step_m: core.jump.max_step,
            jump_policy: Jump::Reject,
            initial_pose: None,
            laser: None,
            resolution: core.resolution,
            occupied_threshold: core.map.occupied_threshold.share,
            occupied_min_visits: None,
            free_on_no_return: core.map.free_on_no_return,
            map_resolution: hector.resolution,
            map_multi_res_levels: hector.levels,
            update_factor_free: hector.free_probability,
            update_factor_occupied: hector.occupied_probability,
            map_update_distance_thresh: hector.update_distance,
            map_update_angle_thresh: hector.update_angle,
            laser_min_dist: hector.min_range,
            laser_max_dist: hector.max_range,
            xmin: -100.0,
            ymin: -100.0,
            xmax: 100.0,
            ymax: 100.0,
            llsamplerange: 0.01,
            llsamplestep: 0.01,
            lasamplerange: 0.005,
            lasamplestep: 0.005,
        }
    }
}

/// Which system maps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EngineKind {
    /// A particle filter.
    Gmapping,
    /// One hypothesis, by matching each scan with the map.
    Hector,
    /// Mapping along poses that somebody else knows.
    KnownPoses,
}

impl EngineKind {
    /// Whether scans without odometry, or without the pose that stands in its place, are of no use
    /// to it.
    #[must_use]
    pub const fn needs_odometry(self) -> bool {
        match self {
            Self::Gmapping | Self::KnownPoses => true,
            Self::Hector => false,
        }
    }
}

/// Where the first scan was taken.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "[x, y, yaw] or search is needed")]
pub enum InitialPose {
    /// There: m, m, rad.
    At([f64; 3]),
    /// Where it fits in the map to start from.
    Search(Search),
}

/// The word that asks for a search.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Search {
    /// In the whole map.
    Search,
}

impl InitialPose {
    /// The pose of the base in `map`, if one is said.
    #[must_use]
    pub fn pose(self) -> Option<Pose2> {
        self.numbers().map(|[x, y, yaw]| Pose2::new(x, y, yaw))
    }

    /// The numbers, if there are any.
    #[must_use]
    pub const fn numbers(self) -> Option<[f64; 3]> {
        match self {
            Self::At(numbers) => Some(numbers),
            Self::Search(_) => None,
        }
    }
}

/// What the map along known poses is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MapOf {
    /// All scans since the beginning.
    AllScans,
    /// The newest scan alone.
    NewestScan,
}

/// How the laser sits on the robot.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Laser {
    /// Metres ahead of the base.
    pub x: f64,
    /// Metres to the left of the base.
    pub y: f64,
    /// Direction it looks in, radians counter-clockwise from straight ahead.
    pub yaw: f64,
    /// Whether it is mounted upside down.
    pub upside_down: bool,
}

/// The keys of the inputs, under the prefix.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Keys {
    /// Sweeps: `sensor_msgs/LaserScan`.
    pub scan: String,
    /// Odometry: `nav_msgs/Odometry`.
    pub odom: String,
    /// Given poses, for `known_poses`: `geometry_msgs/PoseWithCovarianceStamped` or `PoseStamped`.
    pub pose: String,
    /// Transforms that change: `tf2_msgs/TFMessage`.
    pub tf: String,
    /// Transforms that do not: `tf2_msgs/TFMessage`.
    pub tf_static: String,
}

impl Default for Keys {
    fn default() -> Self {
        Self {
            scan: "scan".to_owned(),
            odom: "odom".to_owned(),
            pose: "amcl_pose".to_owned(),
            tf: "tf".to_owned(),
            tf_static: "tf_static".to_owned(),
        }
    }
}

/// What the mesh may ask for that changes something, as `slam/cmd/NAME`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CommandName {
    /// Write the state to the disk.
    Checkpoint,
    /// Say where the robot is.
    InitialPose,
    /// Let scans enter the map, or freeze it.
    Mode,
    /// Take no scans.
    Pause,
    /// Forget map and trajectory.
    Reset,
    /// Take scans again.
    Resume,
    /// Write the map to files.
    Save,
}

impl CommandName {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::Checkpoint,
        Self::InitialPose,
        Self::Mode,
        Self::Pause,
        Self::Reset,
        Self::Resume,
        Self::Save,
    ];
}

/// How often the state is written, and how many of those writings are kept.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Checkpoint {
    /// Seconds after which scans that came since are written.
    pub every_s: f64,
    /// Scans after which they are, if that is sooner.
    pub every_scans: u64,
    /// Good checkpoints that are kept.
    pub keep: usize,
}

impl Default for Checkpoint {
    fn default() -> Self {
        Self { every_s: 10.0, every_scans: 200, keep: 3 }
    }
}

/// How ROS 2 nodes are met.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Interop {
    /// Through `zenoh-bridge-ros2dds`, to which topics and services are announced.
    Bridge,
    /// They run on `rmw_zenoh`: its keys, attachments and announcements.
    RmwZenoh,
    /// Not at all.
    None,
}

/// Which types' hashes ROS 2 nodes on `rmw_zenoh` know.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RosDistro {
    /// Jazzy and all later: all.
    Jazzy,
    /// None.
    Humble,
}

/// Where odometry comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OdometrySource {
    /// Messages on `odom`, or transforms if there are none when mapping begins.
    Auto,
    /// Messages on `odom`.
    Odom,
    /// Transforms from `odom_frame` to `base_frame`.
    Tf,
    /// Nowhere: the engine has to do without.
    None,
}

/// Which scan matcher runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Matcher {
    /// A cached likelihood field.
    Field,
    /// The original's objective and schedule.
    Compat,
}

/// How log likelihoods become weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Smoothing {
    /// The same for any number of particles.
    Fixed,
    /// Divided by `ogain * N`: the original's rule.
    PerParticle,
}

/// What happens when odometry jumps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Jump {
    /// The jump is taken out.
    Reject,
    /// The jump is believed.
    Continue,
}
