//! What ROS 2 nodes are told, behind a bridge and on `rmw_zenoh`, over real sessions on loopback.

use std::collections::BTreeSet;
use std::time::Duration;

use gmapd::config::Config;
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::{Daemon, Settings};
use gmapd::ros;
use gmapd::ros::graph::rmw_zenoh::Attachment;
use zenoh::Session;
use zenoh::handlers::{FifoChannel, FifoChannelHandler};
use zenoh::pubsub::Subscriber;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::sample::{Sample, SampleKind};

/// Nothing here takes that long; what does will never come.
const PATIENCE: Duration = Duration::from_secs(30);

/// Two sessions that hear nobody else on the machine.
async fn sessions() -> (Session, Session) {
    let open = async |endpoints: String| {
        let config = format!(
            r#"{{ mode: "peer", listen: {{ endpoints: ["tcp/127.0.0.1:0"] }},
                 connect: {{ endpoints: [{endpoints}] }},
                 scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }} }}"#
        );
        let config = zenoh::Config::from_json5(&config).expect("it is well-formed");
        zenoh::open(config).await.expect("loopback is there")
    };
    let daemon = open(String::new()).await;
    let locator = daemon.info().locators().await.first().expect("it listens").to_string();
    let node = open(format!("{locator:?}")).await;
    (daemon, node)
}

async fn start(session: &Session, prefix: &str, settings: &[&str]) -> Daemon {
    let overrides: Vec<String> = settings.iter().map(|text| (*text).to_owned()).collect();
    let config = Config::load(None, &overrides).expect("it is allowed");
    let prefix = Prefix::parse(prefix).expect("it is a key");
    Daemon::start(session, Settings { config, prefix, threads: 1 }).await.expect("it starts")
}

/// What a node hears of tokens, those before it came included.
type Tokens = Subscriber<FifoChannelHandler<Sample>>;

async fn listen(node: &Session, of: &str) -> Tokens {
    let subscriber = node.liveliness().declare_subscriber(of).history(true);
    subscriber.with(FifoChannel::new(1000)).await.expect("it is a key")
}

/// Waits until the robot answers, which is told last.
async fn wait_until_alive(node: &Session) {
    let alive = listen(node, "**/slam/alive").await;
    assert_eq!(next(&alive).await.kind(), SampleKind::Put);
}

async fn next<T>(subscriber: &Subscriber<FifoChannelHandler<T>>) -> T {
    let next = tokio::time::timeout(PATIENCE, subscriber.recv_async()).await;
    next.expect("it comes in time").expect("the subscriber lives")
}

fn tokens(heard: &Tokens) -> BTreeSet<String> {
    let samples = heard.drain();
    samples.map(|sample| sample.key_expr().to_string()).collect()
}

/// The tokens that a node sees of a daemon, before `<zid>` is put in for its session.
async fn announced(prefix: &str, settings: &[&str], of: &str) -> BTreeSet<String> {
    let (session, node) = sessions().await;
    let heard = listen(&node, of).await;
    let daemon = start(&session, prefix, settings).await;
    wait_until_alive(&node).await;
    let tokens = tokens(&heard);
    daemon.stop().await;
    let zid = session.zid().to_string();
    tokens.into_iter().map(|token| token.replace(&zid, "<zid>")).collect()
}

fn lines(text: &str) -> BTreeSet<String> {
    text.split_whitespace().map(str::to_owned).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bridge_is_told_of_topics_and_services() {
    let expected = "
@/<zid>/@ros2_lv/MP/robot01§diagnostics/diagnostic_msgs§msg§DiagnosticArray/:1:0:0,10:typehash=RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e;
@/<zid>/@ros2_lv/MP/robot01§entropy/std_msgs§msg§Float64/:1:0:0,10:typehash=RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a;
@/<zid>/@ros2_lv/MP/robot01§map/nav_msgs§msg§OccupancyGrid/:1:1:0,1:typehash=RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7;
@/<zid>/@ros2_lv/MP/robot01§map_metadata/nav_msgs§msg§MapMetaData/:1:1:0,1:typehash=RIHS01_2772d4b2000ef2b35dbaeb80fd3946c1369f817fb4f75677d916d27c17d763c8;
@/<zid>/@ros2_lv/MP/robot01§map_updates/map_msgs§msg§OccupancyGridUpdate/:1:0:0,10:typehash=RIHS01_c4095b0be2e4363f8978a1570e0293ee093436f1e1c61d99b48502ac317025e8;
@/<zid>/@ros2_lv/MP/robot01§particlecloud/geometry_msgs§msg§PoseArray/:1:0:0,10:typehash=RIHS01_af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0;
@/<zid>/@ros2_lv/MP/robot01§path/nav_msgs§msg§Path/:1:1:0,1:typehash=RIHS01_1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b;
@/<zid>/@ros2_lv/MP/robot01§pose/geometry_msgs§msg§PoseWithCovarianceStamped/:1:0:0,10:typehash=RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e;
@/<zid>/@ros2_lv/MP/robot01§tf/tf2_msgs§msg§TFMessage/:1:0:0,100:typehash=RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087;
@/<zid>/@ros2_lv/MS/robot01§odom/nav_msgs§msg§Odometry/:0:0:0,50:typehash=RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0;
@/<zid>/@ros2_lv/MS/robot01§front§scan/sensor_msgs§msg§LaserScan/:0:0:0,5:typehash=RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828;
@/<zid>/@ros2_lv/MS/robot01§tf/tf2_msgs§msg§TFMessage/:0:0:0,100:typehash=RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087;
@/<zid>/@ros2_lv/MS/robot01§tf_static/tf2_msgs§msg§TFMessage/:1:1:0,100:typehash=RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087;
@/<zid>/@ros2_lv/SS/robot01§dynamic_map/nav_msgs§srv§GetMap";
    let found = announced("robot01", &["keys={scan: front/scan}"], "@/*/@ros2_lv/**").await;
    assert_eq!(found, lines(expected));
    // An empty prefix: the names of a robot without a namespace.
    let found = announced("", &["transform_publish_period=0"], "@/*/@ros2_lv/**").await;
    let expected = lines(&expected.replace("robot01§", "").replace("front§", ""));
    let expected = expected.into_iter().filter(|token| !token.contains("MP/tf/")).collect();
    assert_eq!(found, expected);
}

#[tokio::test(flavor = "multi_thread")]
async fn nodes_on_rmw_zenoh_are_told_of_a_node_and_its_endpoints() {
    let expected = "
@ros2_lv/5/<zid>/0/0/NN/%/%robot01/gmapd
@ros2_lv/5/<zid>/0/1/MS/%/%robot01/gmapd/%robot01%scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828/2:2:1,5:,:,:,,
@ros2_lv/5/<zid>/0/2/MS/%/%robot01/gmapd/%robot01%odom/nav_msgs::msg::dds_::Odometry_/RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0/2:2:1,50:,:,:,,
@ros2_lv/5/<zid>/0/3/MS/%/%robot01/gmapd/%robot01%tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087/2:2:1,100:,:,:,,
@ros2_lv/5/<zid>/0/4/MS/%/%robot01/gmapd/%robot01%tf_static/tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087/1:1:1,100:,:,:,,
@ros2_lv/5/<zid>/0/5/MP/%/%robot01/gmapd/%robot01%map/nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7/1:1:1,1:,:,:,,
@ros2_lv/5/<zid>/0/6/MP/%/%robot01/gmapd/%robot01%map_metadata/nav_msgs::msg::dds_::MapMetaData_/RIHS01_2772d4b2000ef2b35dbaeb80fd3946c1369f817fb4f75677d916d27c17d763c8/1:1:1,1:,:,:,,
@ros2_lv/5/<zid>/0/7/MP/%/%robot01/gmapd/%robot01%path/nav_msgs::msg::dds_::Path_/RIHS01_1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b/1:1:1,1:,:,:,,
@ros2_lv/5/<zid>/0/8/MP/%/%robot01/gmapd/%robot01%pose/geometry_msgs::msg::dds_::PoseWithCovarianceStamped_/RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e/1:2:1,10:,:,:,,
@ros2_lv/5/<zid>/0/9/MP/%/%robot01/gmapd/%robot01%entropy/std_msgs::msg::dds_::Float64_/RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a/1:2:1,10:,:,:,,
@ros2_lv/5/<zid>/0/10/MP/%/%robot01/gmapd/%robot01%particlecloud/geometry_msgs::msg::dds_::PoseArray_/RIHS01_af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0/1:2:1,10:,:,:,,
@ros2_lv/5/<zid>/0/11/MP/%/%robot01/gmapd/%robot01%tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087/1:2:1,100:,:,:,,
@ros2_lv/5/<zid>/0/12/MP/%/%robot01/gmapd/%robot01%diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e/1:2:1,10:,:,:,,
@ros2_lv/5/<zid>/0/13/MP/%/%robot01/gmapd/%robot01%map_updates/map_msgs::msg::dds_::OccupancyGridUpdate_/RIHS01_c4095b0be2e4363f8978a1570e0293ee093436f1e1c61d99b48502ac317025e8/1:2:1,10:,:,:,,
@ros2_lv/5/<zid>/0/14/SS/%/%robot01/gmapd/%robot01%dynamic_map/nav_msgs::srv::dds_::GetMap_/RIHS01_c8ae77c9995b3554b5ba80e4d4d443f970ac65143102a1d893ec24fc07b31147/1:2:1,10:,:,:,,";
    let settings = ["interop=rmw_zenoh", "ros_domain_id=5"];
    let found = announced("robot01", &settings, "@ros2_lv/**").await;
    assert_eq!(found, lines(expected));
    let settings = ["interop=rmw_zenoh", "ros_distro=humble"];
    let humble = announced("", &settings, "@ros2_lv/**").await;
    assert_eq!(humble.len(), 15);
    assert!(humble.contains("@ros2_lv/0/<zid>/0/0/NN/%/%/gmapd"), "{humble:?}");
    assert_eq!(humble.iter().filter(|token| token.contains("/TypeHashNotSupported/")).count(), 14);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_not_asked_for_is_not_announced() {
    for (settings, of) in [
        (&["interop=none"][..], "@/*/@ros2_lv/**"),
        (&["interop=none"], "@ros2_lv/**"),
        (&["interop=bridge"], "@ros2_lv/**"),
        (&["interop=rmw_zenoh"], "@/*/@ros2_lv/**"),
    ] {
        assert_eq!(announced("robot01", settings, of).await, BTreeSet::new(), "{settings:?} {of}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_announced_is_taken_back_at_the_end() {
    for (settings, of) in
        [(["interop=bridge"], "@/*/@ros2_lv/**"), (["interop=rmw_zenoh"], "@ros2_lv/**")]
    {
        let (session, node) = sessions().await;
        let heard = listen(&node, of).await;
        let daemon = start(&session, "robot01", &settings).await;
        wait_until_alive(&node).await;
        let mut tokens = tokens(&heard);
        assert!(tokens.len() >= 13, "{tokens:?}");
        daemon.stop().await;
        while !tokens.is_empty() {
            let sample = next(&heard).await;
            assert_eq!(sample.kind(), SampleKind::Delete);
            assert!(tokens.remove(sample.key_expr().as_str()), "{sample:?}");
        }
    }
}

/// As a node on `rmw_zenoh` calls a service.
async fn call(node: &Session, key: &str, attachment: Option<&[u8]>) -> Sample {
    let replies = node
        .get(key)
        .target(QueryTarget::AllComplete)
        .consolidation(ConsolidationMode::None)
        .payload([0, 1, 0, 0, 0])
        .attachment(attachment)
        .timeout(PATIENCE)
        .await
        .expect("it is a key");
    let reply = replies.recv_async().await.expect("it is answered");
    assert!(replies.recv_async().await.is_err(), "one reply is enough");
    reply.into_result().expect("it is no error")
}

#[tokio::test(flavor = "multi_thread")]
async fn a_node_on_rmw_zenoh_calls_the_service_before_there_is_a_map() {
    let (session, node) = sessions().await;
    let daemon = start(&session, "robot01", &["interop=rmw_zenoh"]).await;
    wait_until_alive(&node).await;
    let key = "0/robot01/dynamic_map/nav_msgs::srv::dds_::GetMap_/\
               RIHS01_c8ae77c9995b3554b5ba80e4d4d443f970ac65143102a1d893ec24fc07b31147";

    let request = Attachment { sequence: 7, sent_ns: 1, gid: [9; 16] };
    let reply = call(&node, key, Some(&request.to_bytes())).await;
    let bytes = reply.attachment().expect("it has one").to_bytes();
    let attachment = Attachment::from_bytes(&bytes).expect("it is one");
    assert_eq!((attachment.sequence, attachment.gid), (7, [9; 16]));
    assert!(attachment.sent_ns > 1_600_000_000_000_000_000, "{attachment:?}");
    let response: ros::GetMapResponse =
        ros::decode(&reply.payload().to_bytes(), "").expect("it is a response");
    assert_eq!((response.map.info.width, response.map.info.height), (0, 0));

    for odd in [None, Some(&b"rqh"[..]), Some(&[0; 33])] {
        let reply = call(&node, key, odd).await;
        assert!(reply.attachment().is_none() && reply.payload().len() > 4, "{odd:?}");
    }
    daemon.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_sent_to_nodes_on_rmw_zenoh_is_numbered_without_gaps() {
    let (session, node) = sessions().await;
    let key = "0/robot01/diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/*";
    let subscriber = node.declare_subscriber(key).await.expect("it is a key");
    let daemon = start(&session, "robot01", &["interop=rmw_zenoh"]).await;
    let mut last: Option<Attachment> = None;
    for _ in 0..2 {
        let sample = next(&subscriber).await;
        let bytes = sample.attachment().expect("it has one").to_bytes();
        let attachment = Attachment::from_bytes(&bytes).expect("it is one");
        if let Some(last) = last {
            assert_eq!((attachment.sequence, attachment.gid), (last.sequence + 1, last.gid));
            assert!(attachment.sent_ns > last.sent_ns);
        }
        last = Some(attachment);
    }
    daemon.stop().await;
}
