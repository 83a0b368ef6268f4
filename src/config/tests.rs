use std::collections::BTreeSet;
use std::path::Path;

use super::*;

fn load(text: &str) -> Result<Config, ConfigError> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("gmapd.yaml");
    std::fs::write(&path, text).unwrap();
    Config::load(Some(&path), &[])
}

/// The message from the file's name on.
fn message(text: &str) -> String {
    let message = load(text).unwrap_err().to_string();
    message[message.find("gmapd.yaml").unwrap()..].to_owned()
}

fn set_message(text: &str) -> String {
    Config::load(None, &[text.to_owned()]).unwrap_err().to_string()
}

fn warnings(text: &str) -> Vec<String> {
    load(text).unwrap().warnings.iter().map(ToString::to_string).collect()
}

#[test]
fn no_file_is_slam_gmappings_defaults() {
    let config = Config::load(None, &[]).unwrap();
    assert_eq!(config.parameters(), Parameters::default());
    assert_eq!(config.raw.particles, 30);
    assert_eq!(load("# nothing\n").unwrap(), config);
}

#[test]
fn particles_left_out_are_thirty() {
    assert_eq!(load("delta: 0.1\n").unwrap().parameters().particles, 30);
}

#[test]
fn every_parameter_of_slam_gmapping_has_its_name() {
    let known: BTreeSet<String> = check::known_keys().into_iter().collect();
    let names = "throttle_scans base_frame map_frame odom_frame map_update_interval \
        transform_publish_period tf_delay maxRange maxUrange sigma kernelSize lstep astep \
        iterations lsigma ogain lskip minimumScore srr srt str stt linearUpdate angularUpdate \
        temporalUpdate resampleThreshold particles xmin ymin xmax ymax delta occ_thresh \
        llsamplerange llsamplestep lasamplerange lasamplestep";
    for name in names.split_whitespace() {
        assert!(known.contains(name), "{name}");
    }
}

#[test]
fn each_style_of_slam_gmapping_file_loads() {
    let parameters = "maxUrange: 16.0\nsigma: 0.05\nkernelSize: 1\nlsigma: 0.075\nminimumScore: 50\n\
        linearUpdate: 1\nparticles: 80\nxmin: -50.0\nodom_frame: odom\ntemporalUpdate: -1.0\n";
    let nested = |indent: &str, head: &str| {
        let lines = parameters.lines().map(|line| format!("{indent}{line}\n"));
        head.to_owned() + &lines.collect::<String>()
    };
    let files = [
        parameters.to_owned(),
        nested("  ", "slam_gmapping:\n"),
        nested("  ", "/slam_gmapping:\n"),
        nested("    ", "slam_gmapping:\n  ros__parameters:\n    use_sim_time: true\n"),
        nested("    ", "/**:\n  ros__parameters:\n    qos_overrides: {a: {b: 1}}\n"),
        nested("  ", "amcl:\n  min_particles: 500\nslam_gmapping:\n"),
    ];
    for file in files {
        let parameters = load(&file).unwrap().parameters();
        assert_eq!((parameters.particles, parameters.max_usable_range), (80, Some(16.0)), "{file}");
        assert_eq!(parameters.gate.linear_update, 1.0);
        assert_eq!(parameters.gate.temporal_update, None);
    }
}

#[test]
fn the_shipped_file_loads_without_a_warning() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/gmapd.yaml");
    assert_eq!(Config::load(Some(&file), &[]).unwrap().warnings, []);
}

/// The shipped file differs from the defaults where it says so, and nowhere else.
#[test]
fn the_shipped_file_has_a_hundred_particles_and_the_defaults() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/gmapd.yaml");
    let raw = Config::load(Some(&path), &[]).unwrap().raw;
    assert_eq!(raw, RawConfig { particles: 100, ..RawConfig::default() });
}

#[test]
fn the_shipped_file_names_every_key_that_has_an_effect() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/gmapd.yaml");
    let text = std::fs::read_to_string(path).unwrap();
    let without_effect = [raw::DEAD_KEYS, raw::EXTENT_KEYS].concat();
    for key in check::known_keys().iter().filter(|key| !without_effect.contains(&key.as_str())) {
        let named = text.lines().any(|line| {
            line.trim_start_matches("# ")
                .strip_prefix(key.as_str())
                .is_some_and(|rest| rest.starts_with(':'))
        });
        assert!(named, "{key}");
    }
}

#[test]
fn an_unknown_key_is_named_with_its_line_and_the_nearest() {
    assert_eq!(
        message("delta: 0.1\npartikles: 3\n"),
        "gmapd.yaml:2: unknown key partikles, did you mean particles?"
    );
    assert_eq!(
        message("maxrange: 3\n"),
        "gmapd.yaml:1: unknown key maxrange, did you mean maxRange?"
    );
    assert_eq!(message("zzz: 3\n"), "gmapd.yaml:1: unknown key zzz");
    assert_eq!(
        message("slam_gmapping:\n  ros__parameters:\n    linear_update: 3\n"),
        "gmapd.yaml:3: unknown key linear_update, did you mean linearUpdate?"
    );
}

#[test]
fn a_value_of_another_kind_is_named_with_what_is_needed() {
    assert_eq!(
        message("delta: 0.1\nparticles: many\n"),
        "gmapd.yaml:2: particles is \"many\": a whole number of at least 0 is needed"
    );
    assert_eq!(message("delta: true\n"), "gmapd.yaml:1: delta is true: a number is needed");
    assert_eq!(message("delta: .nan\n"), "gmapd.yaml:1: delta is \".nan\": a number is needed");
    assert_eq!(
        message("matcher: hector\n"),
        "gmapd.yaml:1: matcher is \"hector\": unknown variant `hector`, expected `field` or `compat`"
    );
    assert_eq!(
        message("tf_delay:\n"),
        "gmapd.yaml:1: tf_delay is null: leave the key out for its default"
    );
    assert_eq!(
        message("laser: {x: 0.1, z: 1}\n"),
        "gmapd.yaml:1: laser is {\"x\":0.1,\"z\":1}: unknown field `z`, expected one of `x`, `y`, \
         `yaw`, `upside_down`"
    );
}

#[test]
fn a_value_out_of_range_is_named_with_the_range() {
    assert_eq!(
        message("\n\nparticles: 0\n"),
        "gmapd.yaml:3: particles is 0; allowed is a number from 1 to 100000"
    );
    assert_eq!(
        message("throttle_scans: 0\n"),
        "gmapd.yaml:1: throttle_scans is 0; allowed is a finite number of at least 1"
    );
    assert_eq!(
        message("maxUrange: -1\n"),
        "gmapd.yaml:1: maxUrange is -1; allowed is a finite number above 0"
    );
    assert_eq!(
        set_message("resampleThreshold=1.5"),
        "--set: resampleThreshold is 1.5; allowed is a number from 0 to 1"
    );
}

#[test]
fn yaml_that_cannot_be_parsed_is_named_with_its_line() {
    assert_eq!(
        message("particles: 3\nparticles: 4\n"),
        "gmapd.yaml:2: particles is given a second time"
    );
    assert!(message("delta: 0.1\ninitial_pose: [1\n").starts_with("gmapd.yaml:2: "));
    assert!(message("- 1\n").starts_with("gmapd.yaml:1: keys and values are needed"));
    assert!(message("delta: 1\n nested: 2\n").starts_with("gmapd.yaml:2: "));
}

#[test]
fn a_missing_file_is_named() {
    let error = Config::load(Some(Path::new("/nowhere/gmapd.yaml")), &[]).unwrap_err();
    assert_eq!(error.to_string(), "cannot read the configuration /nowhere/gmapd.yaml");
}

#[test]
fn overrides_replace_what_the_file_says_and_speak_its_language() {
    let set = ["particles=7", "laser={x: 0.2, upside_down: true}", "initial_pose=[1, 2, 0.5]"];
    let config = Config::load(None, &set.map(str::to_owned)).unwrap();
    let parameters = config.parameters();
    assert_eq!(parameters.particles, 7);
    assert_eq!(parameters.initial_pose, Some(Pose2::new(1.0, 2.0, 0.5)));
    let mount = config.laser_mount().unwrap();
    assert_eq!(mount.base_from_laser, Pose2::new(0.2, 0.0, 0.0));
    assert_eq!(mount.orientation, MountOrientation::UpsideDown);

    assert_eq!(set_message("partikles=3"), "--set: unknown key partikles, did you mean particles?");
    assert_eq!(
        set_message("particles"),
        "--set particles: a key and a value are needed, as in particles=100"
    );
    assert!(set_message("seed=[1").starts_with("--set: seed=[1: "));
}

#[test]
fn keys_without_effect_are_accepted_and_said_to_have_none() {
    assert_eq!(
        warnings("llsamplerange: 0.01\n"),
        ["llsamplerange never had an effect, not in slam_gmapping either"]
    );
    assert_eq!(warnings("xmax: 50\n"), ["xmax has no effect: the map grows without limit"]);
    assert_eq!(
        warnings("use_sim_time: true\n"),
        ["use_sim_time has no effect: it is not a parameter of the filter"]
    );
    assert_eq!(warnings("amcl: {a: 1}\nslam_gmapping: {particles: 3}\n").len(), 1);
}

/// All parameters of hector_mapping and of its trajectory server, with their defaults.
const HECTOR_MAPPING: &str = "\
hector_mapping:
  pub_drawings: false
  pub_debug_output: false
  pub_map_odom_transform: true
  pub_odometry: false
  advertise_map_service: true
  scan_subscriber_queue_size: 5
  map_resolution: 0.025
  map_size: 1024
  map_start_x: 0.5
  map_start_y: 0.5
  map_multi_res_levels: 3
  update_factor_free: 0.4
  update_factor_occupied: 0.9
  map_update_distance_thresh: 0.4
  map_update_angle_thresh: 0.9
  scan_topic: scan
  sys_msg_topic: syscommand
  pose_update_topic: poseupdate
  use_tf_scan_transformation: true
  use_tf_pose_start_estimate: false
  map_with_known_poses: false
  base_frame: base_link
  map_frame: map
  odom_frame: odom
  pub_map_scanmatch_transform: true
  tf_map_scanmatch_transform_frame_name: scanmatcher_frame
  output_timing: false
  map_pub_period: 2.0
  laser_min_dist: 0.4
  laser_max_dist: 30.0
  laser_z_min_value: -1.0
  laser_z_max_value: 1.0
  target_frame_name: map
  source_frame_name: base_link
  trajectory_update_rate: 4.0
  trajectory_publish_rate: 0.25
hector_geotiff_node:
  map_file_path: .
  geotiff_save_period: 0.0
";

#[test]
fn a_whole_file_of_hector_mapping_loads_and_has_the_defaults() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hector.yaml");
    std::fs::write(&path, HECTOR_MAPPING).unwrap();
    let hector = ["engine=hector".to_owned()];
    let config = Config::load(Some(&path), &hector).unwrap();
    assert_eq!(config.raw, Config::load(None, &hector).unwrap().raw);
    let hector = config.hector_parameters();
    assert_eq!((hector.resolution, hector.levels), (0.025, 3));
    assert_eq!((hector.free_probability, hector.occupied_probability), (0.4, 0.9));
    assert_eq!((hector.update_distance, hector.update_angle), (0.4, 0.9));
    assert_eq!((hector.min_range, hector.max_range), (0.4, 30.0));
    let RawConfig { base_frame, map_frame, odom_frame, .. } = &config.raw;
    assert_eq!([base_frame, map_frame, odom_frame], ["base_link", "map", "odom"]);

    // Each of its keys has an effect, or is said to have none.
    let known = check::known_keys();
    let (own, _) = HECTOR_MAPPING.split_once("hector_geotiff_node").unwrap();
    let keys = own.lines().filter(|line| line.starts_with(' '));
    for (key, _) in keys.map(|line| line.trim().split_once(':').unwrap()) {
        let told = |warning: &ConfigWarning| matches!(warning, ConfigWarning::Hectors { key: told, .. } if told == key);
        let known = known.iter().any(|other| other == key);
        assert_eq!(config.warnings.iter().any(told), !known, "{key}");
    }
    let other = ConfigWarning::OtherNode { name: "hector_geotiff_node".to_owned() };
    assert_eq!((config.warnings.len(), config.warnings.contains(&other)), (26, true));
}

#[test]
fn a_key_of_hector_mapping_without_effect_is_told_wherever_it_is_set() {
    let config = Config::load(None, &["map_size=2048".to_owned()]).unwrap();
    let warnings: Vec<String> = config.warnings.iter().map(ToString::to_string).collect();
    let expected = "map_size of hector_mapping has no effect: the map grows without limit";
    assert_eq!(warnings, [expected]);
    assert_eq!(warnings, self::warnings("map_size: 2048\n"));
}

#[test]
fn hector_mappings_switch_for_known_poses_is_an_error_that_names_the_engine() {
    let expected = "map_with_known_poses is true: mapping along known poses is another engine: \
                    leave this out, and set `engine: known_poses`";
    assert_eq!(set_message("map_with_known_poses=true"), format!("--set: {expected}"));
    let file = "hector_mapping:\n  map_with_known_poses: true\n";
    assert_eq!(message(file), format!("gmapd.yaml:2: {expected}"));
    assert_eq!(warnings("map_with_known_poses: false\n").len(), 1);
}

#[test]
fn parameters_of_the_compat_matcher_warn_with_the_field_matcher_only() {
    assert_eq!(
        warnings("sigma: 0.05\nlsigma: 0.075\n"),
        [
            "lsigma has an effect only with \"matcher: compat\"",
            "sigma has an effect only with \"matcher: compat\""
        ]
    );
    assert_eq!(warnings("sigma: 0.05\nmatcher: compat\n"), Vec::<String>::new());
}
