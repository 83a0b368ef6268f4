//! Answers in words. `None` where an answer is not what is expected.

use std::fmt::Write as _;

use gmapd::convert;
use gmapd::ros;
use gmapd::slam::pose::Pose2;
use serde_json::Value;

use super::mesh::Answer;

fn decode<M: ros::Message>(answer: &Answer) -> Option<M> {
    ros::decode(&answer.bytes, &answer.encoding).ok()
}

pub(super) fn pose(answer: &Answer) -> Option<String> {
    let message: ros::PoseWithCovarianceStamped = decode(answer)?;
    let covariance = message.pose.covariance.0;
    let [x, y, yaw] = [0, 7, 35].map(|variance| covariance[variance].max(0.0).sqrt());
    Some(format!(
        "stamp        {}\npose         {}\nspread       {x:.3} m, {y:.3} m, {:.2} degrees\n",
        stamp(message.header.stamp),
        place(in_plane(&message.pose.pose)?),
        yaw.to_degrees()
    ))
}

pub(super) fn cloud(answer: &Answer) -> Option<String> {
    let message: ros::PoseArray = decode(answer)?;
    let mut text = format!("# {} particles: x y yaw, m and rad\n", message.poses.len());
    for pose in &message.poses {
        let Pose2 { x, y, theta } = in_plane(pose)?;
        writeln!(text, "{x:.4} {y:.4} {theta:.4}").ok();
    }
    Some(text)
}

pub(super) fn entropy(answer: &Answer) -> Option<String> {
    decode(answer).map(|ros::Float64 { data }| format!("{data:.4} nats\n"))
}

pub(super) fn map_metadata(answer: &Answer) -> Option<String> {
    let message: ros::MapMetaData = decode(answer)?;
    let ros::MapMetaData { resolution, width, height, origin, .. } = &message;
    Some(format!(
        "stamp        {}\nsize         {width} x {height} cells of {resolution} m\n\
         origin       ({:.3} m, {:.3} m)\n",
        stamp(message.map_load_time),
        origin.position.x,
        origin.position.y
    ))
}

fn stamp(time: ros::Time) -> String {
    format!("{}.{:09} s", time.sec, time.nanosec)
}

fn in_plane(pose: &ros::Pose) -> Option<Pose2> {
    let odometry = ros::Odometry {
        pose: ros::PoseWithCovariance { pose: *pose, ..ros::PoseWithCovariance::default() },
        ..ros::Odometry::default()
    };
    convert::odometry(odometry).ok().map(|sample| sample.odom_from_base)
}

fn place(pose: Pose2) -> String {
    format!("({:.3} m, {:.3} m), {:.1} degrees", pose.x, pose.y, pose.theta.to_degrees())
}

/// Daemons of other versions may tell more or less: each line is there if its figures are.
pub(super) fn status(answer: &Answer) -> Option<String> {
    let status: Value = serde_json::from_slice(&answer.bytes).ok()?;
    let state = status["state"].as_str()?.replace('_', " ");
    let mut text = format!("state        {state}\n");
    let mut line = |name: &str, value: Option<String>| {
        if let Some(value) = value.filter(|value| !value.is_empty()) {
            writeln!(text, "{name:<12} {value}").ok();
        }
    };
    line("", status["detail"].as_str().map(str::to_owned));
    line("map", map_size(&status));
    line("pose", pose_of(&status));
    line("scans", scans(&status));
    line("speed", speed(&status));
    line("filter", filter(&status));
    line("kept", state_on_disk(&status));
    line("memory", megabytes(&status["peak_memory_bytes"]));
    line("daemon", daemon(&status));
    for (name, input) in status["inputs"].as_object().into_iter().flatten() {
        line(name, input_line(input));
    }
    for (verdict, detail) in status["last_details"].as_object().into_iter().flatten() {
        line(&verdict.replace('_', " "), detail.as_str().map(str::to_owned));
    }
    Some(text)
}

/// Where the robot is, as a status tells it.
pub(super) fn pose_of(status: &Value) -> Option<String> {
    let pose = &status["pose_in_map"];
    let coordinate = |name: &str| pose[name].as_f64();
    Some(place(Pose2::new(coordinate("x")?, coordinate("y")?, coordinate("theta")?)))
}

/// The map's size, as a status tells it.
pub(super) fn map_size(status: &Value) -> Option<String> {
    let map = &status["map"];
    let (width, height) = (map["width"].as_u64()?, map["height"].as_u64()?);
    let (area, resolution) = (map["known_area_m2"].as_f64()?, map["resolution"].as_f64()?);
    Some(format!("{area:.0} m2 known, {width} x {height} cells of {resolution} m"))
}

/// Scans by verdict, those that occurred.
pub(super) fn scans(status: &Value) -> Option<String> {
    let counts = status["scans"].as_object()?;
    let all = counts.values().filter_map(Value::as_u64).sum::<u64>();
    let mut text = all.to_string();
    for (verdict, count) in counts {
        if let Some(count) = count.as_u64().filter(|&count| count > 0) {
            write!(text, ", {count} {}", verdict.replace('_', " ")).ok();
        }
    }
    Some(text)
}

fn speed(status: &Value) -> Option<String> {
    let spread = &status["milliseconds_per_scan"];
    let (p50, p99) = (spread["p50"].as_f64()?, spread["p99"].as_f64()?);
    let factor = status["real_time_factor"].as_f64();
    let factor = factor.map_or(String::new(), |factor| format!(", {factor:.0} times real time"));
    Some(format!("{p50:.1} ms a scan, {p99:.1} ms at the 99th percentile{factor}"))
}

fn filter(status: &Value) -> Option<String> {
    let filter = &status["filter"];
    let particles = filter["particles"].as_u64()?;
    let effective = filter["effective_sample_size"].as_f64();
    let effective = effective.map_or(String::new(), |size| format!(", effective {size:.1}"));
    let resamples = filter["resamples"].as_u64().unwrap_or(0);
    Some(format!("{particles} particles{effective}, resampled {resamples} times"))
}

/// The last checkpoint, and why there is no newer one.
fn state_on_disk(status: &Value) -> Option<String> {
    let checkpoint = &status["checkpoint"];
    let error = checkpoint["error"].as_str();
    let last = &checkpoint["last"];
    let written = last["file"].as_str().map(|file| {
        let (scans, bytes) = (&last["scans"], last["bytes"].as_f64().unwrap_or(0.0));
        format!("the state after {scans} scans in {file}, {:.1} MB", bytes / 1e6)
    });
    match (written, error) {
        (Some(written), Some(error)) => Some(format!("{written}; {error}")),
        (written, error) => written.or(error.map(str::to_owned)),
    }
}

fn megabytes(bytes: &Value) -> Option<String> {
    bytes.as_f64().map(|bytes| format!("{:.1} MB at most", bytes / 1e6))
}

fn daemon(status: &Value) -> Option<String> {
    let uptime = status["uptime_s"].as_f64()?;
    Some(format!("gmapd {}, up for {uptime:.0} s", status["version"].as_str()?))
}

fn input_line(input: &Value) -> Option<String> {
    let received = input["received"].as_u64()?;
    let mut text = format!("{}: {received} received", input["key"].as_str()?);
    for count in ["rejected", "dropped", "duplicates", "reordered", "clock_restarts", "gaps"] {
        if let Some(number) = input[count].as_u64().filter(|&number| number > 0) {
            write!(text, ", {number} {}", count.replace('_', " ")).ok();
        }
    }
    if let Some(age) = input["age_s"].as_f64() {
        write!(text, ", the last {age:.1} s ago").ok();
    }
    if let Some(reason) = input["last_rejection"].as_str() {
        write!(text, "; {reason}").ok();
    }
    Some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer(bytes: &[u8]) -> Answer {
        Answer { bytes: bytes.to_vec(), encoding: "application/json".to_owned() }
    }

    #[test]
    fn a_status_is_told_in_lines() {
        let status = br#"{"version":"0.1.0","uptime_s":12.3,"state":"waiting_for_scans",
            "detail":"no scan came","pose_in_map":{"x":1.0,"y":2.0,"theta":0.0},
            "scans":{"processed":5,"late":0,"not_moved_enough":2},
            "inputs":{"scan":{"key":"r/scan","received":7,"rejected":1,"last_rejection":"bad"}},
            "milliseconds_per_scan":null,"map":null,"filter":{"particles":30,"resamples":0},
            "checkpoint":{"error":"no room","last":{"file":"a.state","scans":7,"bytes":1234567}}}"#;
        let text = super::status(&answer(status)).unwrap();
        assert!(text.starts_with("state        waiting for scans\n             no scan came\n"));
        assert!(
            text.contains("scans        7, 2 not moved enough, 5 processed\n")
                || text.contains("scans        7, 5 processed, 2 not moved enough\n"),
            "{text}"
        );
        assert!(text.contains("scan         r/scan: 7 received, 1 rejected; bad\n"), "{text}");
        let kept = "kept         the state after 7 scans in a.state, 1.2 MB; no room\n";
        assert!(text.contains(kept), "{text}");
        assert!(!text.contains("map ") && !text.contains("speed"), "{text}");
        assert_eq!(super::status(&answer(b"{}")), None);
    }

    #[test]
    fn a_pose_is_told_with_its_spread() {
        let mut message = ros::PoseWithCovarianceStamped::default();
        message.pose.pose = convert::pose(Pose2::new(1.0, -2.0, std::f64::consts::FRAC_PI_2));
        message.pose.covariance.0[7] = 0.25;
        let text = pose(&answer(&ros::json(&message))).unwrap();
        assert!(text.contains("(1.000 m, -2.000 m), 90.0 degrees"), "{text}");
        assert!(text.contains("spread       0.000 m, 0.500 m, 0.00 degrees"), "{text}");
        assert_eq!(pose(&answer(b"{}")), None);
    }
}
