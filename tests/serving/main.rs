//! What the daemon publishes and answers, over real sessions on loopback.

use std::sync::Arc;
use std::time::Duration;

use gmapd::config::CommandName;
use gmapd::daemon::command::{Command, Done};
use gmapd::daemon::ledger::{Entry, Verdict};
use gmapd::daemon::snapshot::{MapVersion, Snapshot};
use gmapd::map;
use gmapd::ros;
use gmapd::slam::grid::occupancy::{OccupancyGrid, OccupiedThreshold};
use gmapd::slam::known_map::Mode;
use gmapd::slam::pose::{Pose2, Stamp};
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::task::JoinSet;
use zenoh::bytes::ZBytes;
use zenoh::sample::{Sample, SampleKind};

mod rig;
mod router;
#[path = "../support/mod.rs"]
mod support;
mod tiles;

use rig::open;
use rig::{
    PATIENCE, ROBOT, Rig, ask, ask_all, drive, late_joiner, leave, liveliness, locator, message,
    next,
};

type PoseMessage = ros::PoseWithCovarianceStamped;

fn last() -> Snapshot {
    drive().pop().expect("there are some")
}

fn version(snapshot: &Snapshot) -> &MapVersion {
    snapshot.map.as_ref().expect("it has a map")
}

fn grid(snapshot: &Snapshot) -> OccupancyGrid {
    version(snapshot)
        .occupancy
        .to_grid(OccupiedThreshold::of_share(0.25))
        .expect("the robot saw something")
}

fn stamp(time: ros::Time) -> Stamp {
    Stamp(i64::from(time.sec) * 1_000_000_000 + i64::from(time.nanosec))
}

/// A stamp as `at=` takes it.
fn at(stamp: Stamp) -> String {
    format!("{}.{:09}", stamp.0 / 1_000_000_000, stamp.0 % 1_000_000_000)
}

#[tokio::test(flavor = "multi_thread")]
async fn the_map_is_answered_in_every_format() {
    let snapshot = last();
    let grid = grid(&snapshot);
    let rig = Rig::start(snapshot.clone()).await;

    for selector in ["map", "map?format=cdr"] {
        let map: ros::OccupancyGrid = rig.ask_message(selector).await;
        assert_eq!((map.info.width as usize, map.info.height as usize), (grid.width, grid.height));
        assert_eq!(map.data, ros::Int8Array::from(grid.cells.as_slice()));
        assert_eq!(map.header.frame_id, "map");
        assert_eq!(stamp(map.header.stamp), version(&snapshot).stamp);
    }
    let answer = async |format: &str| rig.ask(&format!("map?format={format}")).await.unwrap();

    let json = answer("json").await;
    assert_eq!(json.encoding, "application/json");
    assert_eq!(json.bytes, map::json(&grid).into_bytes());

    let png = answer("png").await;
    assert_eq!(png.encoding, "image/png");
    let picture = png::Decoder::new(std::io::Cursor::new(&png.bytes)).read_info().unwrap();
    let (width, height) = (picture.info().width as usize, picture.info().height as usize);
    assert!(width > grid.width && height > grid.height, "{width} x {height}");

    let pgm = answer("pgm").await;
    assert_eq!(pgm.encoding, "image/x-portable-graymap");
    let header = format!("P5\n{} {}\n255\n", grid.width, grid.height);
    assert!(pgm.bytes.starts_with(header.as_bytes()));
    assert_eq!(pgm.bytes.len(), header.len() + grid.cells.len());

    let yaml = answer("yaml").await;
    assert_eq!(yaml.encoding, "application/yaml");
    let text = String::from_utf8(yaml.bytes).unwrap();
    let file: serde_json::Value = serde_saphyr::from_str(&text).unwrap();
    assert_eq!(file["image"], "map.pgm");
    assert_eq!(file["resolution"], grid.resolution);
    assert_eq!(file["origin"], serde_json::json!([grid.origin.x, grid.origin.y, 0]));

    let text = answer("text;cols=30").await;
    assert_eq!(text.encoding, "text/plain");
    let text = String::from_utf8(text.bytes).unwrap();
    let drawing: Vec<&str> = text.lines().rev().skip(1).collect();
    assert!(drawing.iter().all(|line| line.chars().count() <= 30), "{text}");
    assert!(drawing.concat().contains(['→', '↗', '↑', '↖', '←', '↙', '↓', '↘']), "{text}");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_attachment_tells_which_map_it_is() {
    let snapshot = last();
    let expected = serde_json::json!({
        "stamp": {
            "sec": version(&snapshot).stamp.0 / 1_000_000_000,
            "nanosec": version(&snapshot).stamp.0 % 1_000_000_000,
        },
        "version": version(&snapshot).version,
        "sha256": map::content_hash(&grid(&snapshot)),
    });
    let rig = Rig::start(snapshot).await;
    for selector in ["map", "map?format=png", "map?format=text", "map_metadata"] {
        let answer = rig.ask(selector).await.unwrap();
        assert_eq!(answer.attachment.as_ref(), Some(&expected), "{selector}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_no_map_is_answered_as_json_and_as_cdr() {
    let snapshot = last();
    let grid = grid(&snapshot);
    let rig = Rig::start(snapshot.clone()).await;
    let estimate = &snapshot.estimate;

    let metadata: ros::MapMetaData = rig.ask_both("map_metadata").await;
    assert_eq!((metadata.width as usize, metadata.height as usize), (grid.width, grid.height));

    let pose: PoseMessage = rig.ask_both("pose").await;
    assert_eq!(pose.pose.pose.position.x, estimate.pose_in_map.x);
    assert_eq!(pose.pose.covariance.0[0], estimate.covariance[(0, 0)]);

    let path: ros::Path = rig.ask_both("path").await;
    assert_eq!(path.poses.len(), version(&snapshot).path.len());
    let tum = rig.ask("path?format=tum").await.unwrap();
    assert_eq!(tum.encoding, "text/plain");
    assert_eq!(String::from_utf8(tum.bytes).unwrap().lines().count(), path.poses.len());

    let cloud: ros::PoseArray = rig.ask_both("particlecloud").await;
    assert_eq!(cloud.poses.len(), estimate.particles.len());

    let entropy: ros::Float64 = rig.ask_both("entropy").await;
    assert_eq!(Some(entropy.data), estimate.report.as_ref().map(|report| report.entropy));

    let status = rig.ask_json("slam/status").await;
    assert_eq!(status["version"], "1.2.3");
    assert_eq!(status["state"], "waiting_for_odometry");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_pose_of_the_past_is_on_the_corrected_path() {
    let snapshot = last();
    let path: Vec<(Stamp, Pose2)> = version(&snapshot).path.iter().collect();
    let rig = Rig::start(snapshot).await;
    let x_at = async |stamp: Stamp| {
        let selector = format!("pose?at={};format=cdr", at(stamp));
        let pose: PoseMessage = rig.ask_message(&selector).await;
        assert_eq!(self::stamp(pose.header.stamp), stamp);
        pose.pose.pose.position.x
    };
    let [(before, earlier), (after, later)] = [path[3], path[4]];
    assert_eq!(x_at(before).await, earlier.x);
    let halfway = x_at(Stamp(i64::midpoint(before.0, after.0))).await;
    assert!((halfway - f64::midpoint(earlier.x, later.x)).abs() < 1e-12, "{halfway}");

    let first = path[0].0;
    let error = rig.ask(&format!("pose?at={}", at(Stamp(first.0 - 1)))).await.unwrap_err();
    let span = format!("which is from {} to {}", at(first), at(path[path.len() - 1].0));
    assert!(error.ends_with(&span), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn before_the_first_scan_there_is_an_empty_map_and_a_sentence_for_the_rest() {
    let rig = Rig::start(Snapshot::default()).await;
    let map: ros::OccupancyGrid = rig.ask_message("map").await;
    assert_eq!((map.info.width, map.info.height, map.info.resolution), (0, 0, 0.05));
    let json = rig.ask_json("map?format=json").await;
    assert_eq!((&json["width"], &json["runs"]), (&0.into(), &serde_json::json!([])));
    let attachment = rig.ask("map").await.unwrap().attachment.unwrap();
    assert_eq!(attachment["version"], 0);
    let response: ros::GetMapResponse = rig.ask_message("dynamic_map").await;
    assert_eq!(response.map, map);
    assert_eq!(rig.ask_json("path").await["poses"], serde_json::json!([]));
    for format in ["png", "pgm", "yaml", "text"] {
        let error = rig.ask(&format!("map?format={format}")).await.unwrap_err();
        assert!(error.starts_with("there is no map to show yet"), "{format}: {error}");
    }
    for (selector, beginning) in [
        ("pose", "the pose is not known yet"),
        ("pose?at=1", "there is no trajectory yet"),
        ("entropy", "the entropy is not known yet"),
        ("slam/cmd/save", "there is no map to save yet"),
    ] {
        let error = rig.ask(selector).await.unwrap_err();
        assert!(error.starts_with(beginning), "{selector}: {error}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_makes_no_sense_is_named_and_what_is_allowed_is_listed() {
    let mut rig = Rig::start(last()).await;
    for (selector, words) in [
        ("map?format=pgn", ["\"pgn\"", "cdr, json, png, pgm, yaml, text"]),
        ("map?fromat=png", ["\"fromat\"", "format, cols"]),
        ("map?format=text;cols=wide", ["\"wide\"", "from 1 to 1000"]),
        ("map?format=png;format=png", ["format", "twice"]),
        ("map_metadata?format=png", ["\"png\"", "json, cdr"]),
        ("pose?at=yesterday", ["\"yesterday\"", "seconds"]),
        ("path?format=gpx", ["\"gpx\"", "json, cdr, tum"]),
        ("particlecloud?count=3", ["\"count\"", "format"]),
        ("entropy?format=xml", ["\"xml\"", "json, cdr"]),
        ("slam/status?verbose", ["\"verbose\"", "format"]),
        ("slam/cmd/pause?for=3", ["\"for\"", "none is allowed"]),
        ("slam/cmd/reset?x=1;y=2", ["yaw", "missing"]),
        ("slam/cmd/initial_pose", ["x and y in metres", "yaw in radians"]),
        ("slam/cmd/initial_pose?x=far;y=2;yaw=0", ["\"far\"", "metres"]),
        ("slam/cmd/mode", ["mode=mapping", "mode=localization"]),
        ("slam/cmd/mode?mode=frozen", ["\"frozen\"", "mapping, localization"]),
        ("slam/cmd/save?name=../../etc/passwd", ["\"../../etc/passwd\"", "slash"]),
        ("slam/cmd/save?name=", ["\"\"", "is empty"]),
    ] {
        let error = rig.ask(selector).await.unwrap_err();
        assert!(words.iter().all(|word| error.contains(word)), "{selector}: {error}");
    }
    assert!(rig.commands.try_recv().is_err(), "nothing of this reached the filter");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_service_of_slam_gmapping_answers_whatever_is_sent() {
    let snapshot = last();
    let rig = Rig::start(snapshot.clone()).await;
    let map: ros::OccupancyGrid = rig.ask_message("map").await;
    let key = format!("{ROBOT}/dynamic_map");
    let requests: [&[u8]; 5] =
        [&[], &[0, 1, 0, 0], &[0, 1, 0, 0, 0], &[0, 1, 0, 0, 0, 0, 0, 0], b"rubbish"];
    for request in requests {
        let replies = rig.client.get(&key).payload(request.to_vec()).attachment("rqh").await;
        let reply = replies.unwrap().recv_async().await.unwrap();
        let sample = reply.into_result().expect("it is never an error");
        let response: ros::GetMapResponse = message(&sample);
        assert_eq!(response.map, map, "{request:?}");
    }
    let response: ros::GetMapResponse = rig.ask_message("dynamic_map?format=nonsense").await;
    assert_eq!(response.map, map);
}

#[tokio::test(flavor = "multi_thread")]
async fn commands_reach_the_filter_and_its_answer_comes_back() {
    let mut rig = Rig::start(Snapshot::default()).await;
    let commands = [
        ("reset", Command::Reset(None)),
        ("reset?x=1;y=-2.5;yaw=0.5", Command::Reset(Some(Pose2::new(1.0, -2.5, 0.5)))),
        ("pause", Command::Pause),
        ("resume", Command::Resume),
        ("initial_pose?x=3;y=4;yaw=-1", Command::InitialPose(Pose2::new(3.0, 4.0, -1.0))),
        ("mode?mode=localization", Command::Mode(Mode::Localization)),
        ("mode?mode=mapping", Command::Mode(Mode::Mapping)),
    ];
    for (selector, command) in commands {
        let client = rig.client.clone();
        let selector = format!("slam/cmd/{selector}");
        let asked = tokio::spawn(async move { ask(&client, &selector).await });
        let request = rig.commands.recv().await.unwrap();
        assert_eq!(request.command, command);
        let done = Done { done: format!("{command:?}"), changed: true };
        request.reply.send(done.clone()).unwrap();
        let answer = asked.await.unwrap().unwrap();
        let reply: serde_json::Value = serde_json::from_slice(&answer.bytes).unwrap();
        assert_eq!(reply, serde_json::to_value(&done).unwrap());
        assert_eq!(answer.encoding, "application/json");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_is_not_lost_in_silence_when_the_filter_stops() {
    let mut rig = Rig::start(Snapshot::default()).await;
    let client = rig.client.clone();
    let asked = tokio::spawn(async move { ask(&client, "slam/cmd/pause").await });
    drop(rig.commands.recv().await.unwrap());
    assert!(asked.await.unwrap().unwrap_err().contains("the daemon is stopping"));
    drop(rig.commands);
    let error = ask(&rig.client, "slam/cmd/pause").await.unwrap_err();
    assert_eq!(error, "the daemon is stopping; the command was not done");
}

/// Who looks at all keys of a robot must not reset it.
#[tokio::test(flavor = "multi_thread")]
async fn a_wildcard_asks_everything_and_commands_nothing() {
    let mut rig = Rig::start(last()).await;
    let answers = ask_all(&rig.client, &format!("{ROBOT}/**")).await;
    let mut keys: Vec<&str> = answers.iter().flatten().map(|answer| answer.key.as_str()).collect();
    keys.sort_unstable();
    let names = [
        "dynamic_map",
        "entropy",
        "map",
        "map_metadata",
        "particlecloud",
        "path",
        "pose",
        "slam/status",
        "slam/tiles",
    ];
    assert_eq!(keys, names.map(|name| format!("{ROBOT}/{name}")));
    let refusals: Vec<&String> =
        answers.iter().filter_map(|answer| answer.as_ref().err()).collect();
    assert_eq!(refusals.len(), 7, "{refusals:?}");
    assert!(refusals.iter().all(|error| error.contains("wildcard")), "{refusals:?}");
    assert!(rig.commands.try_recv().is_err());
    assert!(!rig.directory.path().join("maps").exists());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_map_is_saved_in_its_directory_and_nowhere_else() {
    let snapshot = last();
    let rig = Rig::start(snapshot.clone()).await;
    let maps = rig.directory.path().join("maps");
    for name in ["map", "office 2"] {
        let selector = format!("slam/cmd/save?name={name}");
        let saved = rig.ask_json(if name == "map" { "slam/cmd/save" } else { &selector }).await;
        assert_eq!(saved["version"], version(&snapshot).version);
        assert_eq!(saved["map_sha256"], map::content_hash(&grid(&snapshot)));
        let files = saved["files"].as_array().unwrap();
        let paths: Vec<&str> = files.iter().map(|file| file["path"].as_str().unwrap()).collect();
        let expected =
            ["pgm", "png", "tum", "yaml"].map(|ending| maps.join(format!("{name}.{ending}")));
        assert_eq!(paths, expected.each_ref().map(|path| path.to_str().unwrap()));
        let hash = &files[0]["sha256"];
        assert_eq!(hash.as_str().map(str::len), Some(64));
    }
    assert_eq!(std::fs::read(maps.join("map.pgm")).unwrap(), map::pgm(&grid(&snapshot)));
    let yaml = std::fs::read_to_string(maps.join("office 2.yaml")).unwrap();
    assert!(yaml.starts_with("image: \"office 2.pgm\"\n"), "{yaml}");
    let tum = std::fs::read_to_string(maps.join("map.tum")).unwrap();
    assert_eq!(tum.lines().count(), version(&snapshot).path.len());
    assert_eq!(std::fs::read_dir(&maps).unwrap().count(), 8);

    for name in ["", "..", "../up", "/tmp/x", "a/b", ".hidden", "a\u{7}b"] {
        let selector = format!("slam/cmd/save?name={name}");
        assert!(rig.ask(&selector).await.unwrap_err().starts_with("name="), "{name:?}");
    }
    assert!(rig.ask(&format!("slam/cmd/save?name={}", "x".repeat(101))).await.is_err());
    assert_eq!(std::fs::read_dir(&maps).unwrap().count(), 8);
    assert_eq!(std::fs::read_dir(rig.directory.path()).unwrap().count(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_directory_that_cannot_be_made_is_named() {
    let rig = Rig::start(last()).await;
    let maps = rig.directory.path().join("maps");
    std::fs::write(&maps, "in the way").unwrap();
    let error = rig.ask("slam/cmd/save").await.unwrap_err();
    assert!(error.starts_with(&format!("cannot make the directory {}", maps.display())), "{error}");
}

/// Receives maps until that of this snapshot comes.
async fn until_map_of(maps: &mut UnboundedReceiver<Sample>, snapshot: &Snapshot) {
    loop {
        let map: ros::OccupancyGrid = message(&next(maps).await);
        if stamp(map.header.stamp) == version(snapshot).stamp {
            assert_eq!(map.data, ros::Int8Array::from(grid(snapshot).cells.as_slice()));
            return;
        }
    }
}

/// Receives poses until that of this snapshot comes.
async fn until_pose_of(poses: &mut UnboundedReceiver<Sample>, snapshot: &Snapshot) {
    loop {
        let pose: PoseMessage = message(&next(poses).await);
        if Some(stamp(pose.header.stamp)) == snapshot.estimate.stamp {
            return;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn who_subscribes_late_gets_the_newest_map_first_or_not() {
    let drive = drive();
    let [.., older, newer] = drive.as_slice() else { panic!("it is longer") };
    let rig = Rig::start(older.clone()).await;

    // The first subscriber ever: nothing was put for nobody.
    let (first, mut maps) = late_joiner(&rig.client, "map").await;
    until_map_of(&mut maps, older).await;
    // One more while the first is there finds it in the cache.
    let client = open("peer", Some(&locator(&rig.daemon).await)).await;
    let (second, mut maps) = late_joiner(&client, "map").await;
    until_map_of(&mut maps, older).await;
    let (metadata, mut sizes) = late_joiner(&client, "map_metadata").await;
    let size: ros::MapMetaData = message(&next(&mut sizes).await);
    assert_eq!(size.width as usize, grid(older).width);
    metadata.undeclare().await.unwrap();

    // All leave, the map goes on, somebody comes.
    leave(&rig, vec![first, second]).await;
    rig.show(newer);
    let (_third, mut maps) = late_joiner(&client, "map").await;
    until_map_of(&mut maps, newer).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_encoded_for_nobody() {
    let drive = drive();
    let rig = Rig::start(drive[3].clone()).await;
    let mut poses = rig.subscribe("pose").await;
    for snapshot in &drive[4..9] {
        rig.show(snapshot);
        until_pose_of(&mut poses, snapshot).await;
    }
    let (_subscriber, mut maps) = late_joiner(&rig.client, "map").await;
    let map = next(&mut maps).await;
    assert_eq!(map.source_info().unwrap().source_sn(), 0, "it is the first that was put");
    assert_eq!(stamp(message::<ros::OccupancyGrid>(&map).header.stamp), version(&drive[8]).stamp);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_map_that_did_not_change_is_not_published_again() {
    let drive = drive();
    let (first, changed) = (&drive[3], &drive[8]);
    let rig = Rig::start(first.clone()).await;
    let mut maps = rig.subscribe("map").await;
    let mut paths = rig.subscribe("path").await;
    until_map_of(&mut maps, first).await;
    next(&mut paths).await;

    let (later, known) = (version(&drive[4]), version(first));
    let same = MapVersion { occupancy: known.occupancy.clone(), ..later.clone() };
    rig.show(&Snapshot { map: Some(Arc::new(same)), ..first.clone() });
    let path: ros::Path = message(&next(&mut paths).await);
    assert_eq!(stamp(path.header.stamp), later.stamp, "the version was seen");

    rig.show(changed);
    let map: ros::OccupancyGrid = message(&next(&mut maps).await);
    assert_eq!(stamp(map.header.stamp), version(changed).stamp);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_long_path_is_published_in_excerpts_and_answered_as_a_whole() {
    let first = drive()[3].clone();
    let pose = |i: i64| (Stamp(1_000_000_000 * i), Pose2::new(i as f64, 0.0, 0.0));
    let long = MapVersion { path: (0..5000).map(pose).collect(), ..version(&first).clone() };
    let rig = Rig::start(Snapshot { map: Some(Arc::new(long)), ..first }).await;
    let mut paths = rig.subscribe("path").await;
    let published: ros::Path = message(&next(&mut paths).await);
    let xs: Vec<f64> = published.poses.iter().map(|pose| pose.pose.position.x).collect();
    assert!(xs.len() <= 2048, "{}", xs.len());
    assert_eq!((xs[0], xs[1]), (0.0, 4.0));
    assert!(xs.ends_with(&[4997.0, 4998.0, 4999.0]));
    let whole: ros::Path = rig.ask_both("path").await;
    assert_eq!(whole.poses.len(), 5000);
}

#[tokio::test(flavor = "multi_thread")]
async fn maps_keep_their_distance_and_who_comes_anew_does_not_wait() {
    let drive = drive();
    let daemon = open("peer", None).await;
    let client = open("peer", Some(&locator(&daemon).await)).await;
    let hour = Duration::from_secs(3600);
    let rig =
        Rig::with(daemon, client, drive[3].clone(), |settings| settings.map_update_interval = hour)
            .await;
    let mut poses = rig.subscribe("pose").await;
    let (first, mut maps) = late_joiner(&rig.client, "map").await;
    until_map_of(&mut maps, &drive[3]).await;
    for snapshot in &drive[4..6] {
        rig.show(snapshot);
        until_pose_of(&mut poses, snapshot).await;
    }
    leave(&rig, vec![first]).await;
    assert!(maps.try_recv().is_err(), "the hour has not passed");
    // Who comes in the moment the other leaves may look like the same: then once more.
    for _ in 0..20 {
        let (second, mut maps) = late_joiner(&rig.client, "map").await;
        let newest = until_map_of(&mut maps, &drive[5]);
        if tokio::time::timeout(Duration::from_secs(1), newest).await.is_ok() {
            return;
        }
        leave(&rig, vec![second]).await;
    }
    panic!("who comes anew waits for the hour to pass");
}

#[tokio::test(flavor = "multi_thread")]
async fn poses_particles_and_entropy_come_with_each_scan() {
    let drive = drive();
    let rig = Rig::start(Snapshot::default()).await;
    let mut poses = rig.subscribe("pose").await;
    let mut clouds = rig.subscribe("particlecloud").await;
    let mut entropies = rig.subscribe("entropy").await;
    for snapshot in &drive[5..8] {
        rig.show(snapshot);
        let estimate = &snapshot.estimate;
        let pose: PoseMessage = message(&next(&mut poses).await);
        assert_eq!(Some(stamp(pose.header.stamp)), estimate.stamp);
        assert_eq!(pose.pose.pose.position.x, estimate.pose_in_map.x);
        assert_eq!(pose.header.frame_id, "map");
        let cloud: ros::PoseArray = message(&next(&mut clouds).await);
        assert_eq!(cloud.poses.len(), estimate.particles.len());
        let entropy: ros::Float64 = message(&next(&mut entropies).await);
        assert_eq!(Some(entropy.data), estimate.report.as_ref().map(|report| report.entropy));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn map_to_odom_is_sent_in_the_time_of_the_messages_and_goes_on() {
    let snapshot = last();
    let rig = Rig::start(snapshot.clone()).await;
    let mut transforms = rig.subscribe("tf").await;
    let newest = snapshot.estimate.stamp.unwrap();
    let mut before = newest;
    for _ in 0..5 {
        let message: ros::TfMessage = message(&next(&mut transforms).await);
        let [transform] = message.transforms.as_slice() else { panic!("one transform") };
        assert_eq!(
            (transform.header.frame_id.as_str(), transform.child_frame_id.as_str()),
            ("map", "odom")
        );
        assert_eq!(transform.transform.translation.x, snapshot.estimate.map_from_odom.x);
        let now = stamp(transform.header.stamp);
        assert!(now > before, "{now:?} after {before:?}");
        assert!(now.seconds_since(newest) < PATIENCE.as_secs_f64(), "{now:?}");
        before = now;
    }
    assert!(before.seconds_since(newest) > 0.02 + 0.06, "five periods have passed");
}

#[tokio::test(flavor = "multi_thread")]
async fn diagnostics_tell_the_state() {
    let rig = Rig::start(Snapshot::default()).await;
    let mut diagnostics = rig.subscribe("diagnostics").await;
    let message: ros::DiagnosticArray = message(&next(&mut diagnostics).await);
    let status = &message.status[0];
    assert_eq!(status.level, ros::DiagnosticStatus::ERROR);
    assert_eq!(
        (status.message.as_str(), status.hardware_id.as_str()),
        ("odometry is missing", ROBOT)
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn the_newest_verdict_arrives_however_many_there_are() {
    let rig = Rig::start(Snapshot::default()).await;
    let mut verdicts = rig.subscribe("slam/verdict").await;
    for number in 1..=500 {
        let entry = Entry {
            number,
            stamp: Some(Stamp(7)),
            verdict: Verdict::NotMovedEnough,
            detail: String::new(),
            weak_direction: None,
        };
        rig.verdicts.send(entry).unwrap();
    }
    let mut last = 0;
    while last < 500 {
        let sample = next(&mut verdicts).await;
        let entry: serde_json::Value =
            serde_json::from_slice(&sample.payload().to_bytes()).unwrap();
        assert_eq!(entry["verdict"], "not_moved_enough");
        let number = entry["number"].as_u64().unwrap();
        assert!(number > last, "{number} after {last}");
        last = number;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn everything_works_through_a_router() {
    let router = open("router", None).await;
    let locator = locator(&router).await;
    let daemon = open("client", Some(&locator)).await;
    let client = open("client", Some(&locator)).await;
    let drive = drive();
    let [.., older, newer] = drive.as_slice() else { panic!("it is longer") };
    let rig = Rig::between(daemon, client, older.clone()).await;
    let answer = rig.ask("map?format=pgm").await.unwrap();
    assert_eq!(answer.bytes, map::pgm(&grid(older)));
    let (_subscriber, mut maps) = late_joiner(&rig.client, "map").await;
    until_map_of(&mut maps, older).await;
    rig.show(newer);
    until_map_of(&mut maps, newer).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn of_many_queries_at_once_each_gets_one_reply() {
    let rig = Rig::start(last()).await;
    let map = rig.ask("map").await.unwrap();
    let (sender, mut replies) = unbounded_channel();
    let asked = 400;
    for number in 0..asked {
        let sender = sender.clone();
        let format = if number % 2 == 0 { "cdr" } else { "png" };
        let send = move |reply: zenoh::query::Reply| drop(sender.send((format, reply)));
        let selector = format!("{ROBOT}/map?format={format}");
        let get = rig.client.get(selector).payload(ZBytes::from(vec![0; 10_000]));
        get.timeout(PATIENCE).callback(send).await.unwrap();
    }
    drop(sender);
    let mut answered = 0;
    for _ in 0..asked {
        let (format, reply) = next(&mut replies).await;
        match reply.into_result() {
            Ok(sample) => {
                answered += 1;
                let is_same = sample.payload().to_bytes() == map.bytes;
                assert_eq!(is_same, format == "cdr");
            }
            Err(error) => {
                let error = error.payload().try_to_string().unwrap().into_owned();
                assert_eq!(error, "64 queries are being answered already; ask again");
            }
        }
    }
    assert!(answered >= 64, "{answered}");
    assert!(replies.recv().await.is_none(), "one reply each");
}

#[tokio::test(flavor = "multi_thread")]
async fn commands_that_are_switched_off_or_too_many_and_answers_too_large_are_refused() {
    let daemon = open("peer", None).await;
    let client = open("peer", Some(&locator(&daemon).await)).await;
    let rig = Rig::with(daemon, client, last(), |settings| {
        settings.limits.commands = vec![CommandName::Save];
        settings.limits.commands_per_second = 2;
        settings.limits.max_reply_bytes = 1000;
    });
    let rig = rig.await;
    let refused = rig.ask("slam/cmd/reset").await.unwrap_err();
    assert!(refused.starts_with("slam/cmd/reset is switched off on this robot"), "{refused}");
    let refused = rig.ask("map").await.unwrap_err();
    assert!(refused.contains("max_reply_bytes allows 1000; ask for a part"), "{refused}");
    assert!(rig.ask("map?bbox=-0.5,-0.5,0.5,0.5").await.is_ok());
    let refused = rig.ask("map?bbox=-1,-1,1,1;layers=hits,visits").await.unwrap_err();
    assert!(
        refused.contains("1600 cells in 2 layers, and max_reply_bytes allows 1000"),
        "{refused}"
    );

    let mut saves = JoinSet::new();
    for _ in 0..6 {
        let client = rig.client.clone();
        saves.spawn(async move { ask(&client, "slam/cmd/save").await });
    }
    let (done, refused): (Vec<_>, Vec<_>) =
        saves.join_all().await.into_iter().partition(Result::is_ok);
    assert!(done.len() >= 2 && !refused.is_empty(), "{} were done at once", done.len());
    for error in refused {
        let error = error.unwrap_err();
        assert_eq!(error, "2 commands were given in this second already; ask again");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn after_the_stop_nobody_is_alive_or_answers() {
    let rig = Rig::start(last()).await;
    let mut alive = liveliness(&rig.client).await;
    assert_eq!(next(&mut alive).await.key_expr().as_str(), format!("{ROBOT}/slam/alive"));
    tokio::time::timeout(PATIENCE, rig.serving.stop()).await.unwrap();
    assert_eq!(next(&mut alive).await.kind(), SampleKind::Delete);
    // That the queryables are gone may be heard later, but it is heard.
    while !ask_all(&rig.client, &format!("{ROBOT}/map")).await.is_empty() {
        tokio::task::yield_now().await;
    }
}
