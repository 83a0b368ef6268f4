//! `gmapd play`: a recorded log onto the mesh.

use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use anyhow::{bail, ensure};
use clap::Args;
use gmapd::clock::Stopwatch;
use gmapd::config::{Config, RawConfig};
use gmapd::daemon::frames::FrameNames;
use gmapd::daemon::keys::Prefix;
use gmapd::logs::carmen::CarmenLog;
use gmapd::playback::{Restamper, Survey};
use gmapd::recorded::Recorded;
use gmapd::slam::pose::Stamp;
use tokio::time::sleep;

use super::feed::Feed;
use super::log::{Log, TopicArguments};
use super::mesh;
use super::progress::Progress;
use super::session::SessionArguments;
use super::signals::Signals;

/// A daemon that has subscribed answers soon after.
const DAEMON_PATIENCE: Duration = Duration::from_secs(3);

/// What to play, where and how fast.
#[derive(Debug, Args)]
#[command(after_help = "\
    Publishes tf_static (how the laser sits), odom and scan under the prefix, as ROS 2 CDR with\n\
    the stamps of the log. It begins when somebody subscribes to the scans, and ends when each\n\
    scan has had its verdict.\n\n\
    The log is in CARMEN's format, or a recording of ROS messages (MCAP, or a ROS 1 bag). The\n\
    scans, odometry and transforms of a recording are published as they were recorded, and what\n\
    gmapd replay uses of it is what is played.\n\n\
    With --rate max nothing is dropped: a few scans at a time are on their way, until the daemon\n\
    has said what became of them. Map and path are then those of gmapd replay, byte for byte.\n\n\
    With --restamp a stamp that is not after the one before it becomes that one plus the log's\n\
    usual period (the median step); all other stamps stay.\n\n\
    Examples:\n  \
        gmapd run --prefix robot01\n  \
        gmapd play run.log --prefix robot01\n  \
        gmapd play run.log --prefix robot01 --rate max -e tcp/192.168.1.5:7447\n  \
        gmapd play intel-all-scans.log --prefix robot01 --rate 20 --restamp")]
pub(crate) struct Arguments {
    /// Recorded log
    log: PathBuf,
    #[command(flatten)]
    topics: TopicArguments,
    /// What the robot's keys begin with
    #[arg(long, value_name = "PREFIX", default_value = "", value_parser = Prefix::parse)]
    prefix: Prefix,
    /// Seconds of the log a second, or max: as fast as the daemon maps
    #[arg(long, value_name = "RATE", default_value = "1.0")]
    rate: Rate,
    /// Give the readings of a CARMEN log stamps that increase
    #[arg(long)]
    restamp: bool,
    #[command(flatten)]
    session: SessionArguments,
}

/// How fast to play.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Rate {
    /// As fast as the daemon maps.
    Max,
    /// Seconds of the log a second.
    Times(f64),
}

impl FromStr for Rate {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.parse::<f64>() {
            _ if text == "max" => Ok(Self::Max),
            Ok(times) if times.is_finite() && times > 0.0 => Ok(Self::Times(times)),
            _ => Err("a number above 0, or max".to_owned()),
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let config = Config::load(None, &[])?;
    let log = Log::open(&arguments.log, &arguments.topics, &config)?;
    let survey = match &log {
        Log::Carmen(log) => {
            let survey = survey(log)?;
            check(&survey, arguments)?;
            survey
        }
        Log::Recorded(recorded) => {
            check_recorded(recorded, arguments)?;
            log.warn(&arguments.log);
            Survey::default()
        }
    };
    mesh::block_on(async {
        let session = arguments.session.open().await?;
        let mut signals = Signals::listen()?;
        let mut feed = Feed::open(&session, &arguments.prefix).await?;
        let watch = Stopwatch::start();
        let how = tokio::select! {
            played = play(&mut feed, &log, survey, arguments) => played.map(|()| "played"),
            () = signals.next() => Ok("interrupted after"),
        }?;
        println!("{how} {}", told(&feed, watch.elapsed().wall));
        session.close().await.ok();
        Ok(())
    })
}

fn check_recorded(recorded: &Recorded, arguments: &Arguments) -> anyhow::Result<()> {
    let log = arguments.log.display();
    ensure!(!arguments.restamp, "{log} is played as it was recorded; --restamp is for CARMEN logs");
    let FrameNames { base, odom } = recorded.frames();
    let raw = RawConfig::default();
    if *base != raw.base_frame || *odom != raw.odom_frame {
        eprintln!(
            "note: the robot is `{base}` and its odometry `{odom}` there; gmapd run has to be told \
             with --set base_frame={base} --set odom_frame={odom}"
        );
    }
    Ok(())
}

fn survey(log: &CarmenLog) -> anyhow::Result<Survey> {
    let mut survey = Survey::default();
    for reading in log.readings()? {
        survey.add(&reading?);
    }
    Ok(survey)
}

fn check(survey: &Survey, arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments { log, restamp, .. } = arguments;
    if let Some(fault) = survey.stamp_fault().filter(|_| !restamp) {
        bail!("{}: {fault}; --restamp gives it stamps that increase", log.display());
    }
    if let Some(fault) = survey.mount_fault() {
        bail!("{}: {fault}", log.display());
    }
    ensure!(survey.mount().is_some(), "{} has no scans to play", log.display());
    Ok(())
}

async fn play(
    feed: &mut Feed,
    log: &Log,
    survey: Survey,
    arguments: &Arguments,
) -> anyhow::Result<()> {
    eprintln!("waiting for a daemon that takes {}", feed.scan_key());
    feed.somebody_listens().await?;
    while !feed.finds_daemon(DAEMON_PATIENCE).await? {
        eprintln!("warning: somebody takes {}, but no gmapd answers", feed.scan_key());
        if arguments.rate != Rate::Max {
            break;
        }
    }
    match log {
        Log::Carmen(log) => {
            let mount = survey.mount().unwrap_or_default();
            let first_stamp = log.statistics().stamps.map_or(Stamp(0), |(first, _)| first);
            feed.announce(first_stamp, &mount).await?;
            let mut restamper = arguments.restamp.then(|| survey.restamper());
            send_all(feed, log, restamper.as_mut(), arguments.rate).await?;
        }
        Log::Recorded(recorded) => send_recorded(feed, recorded, arguments.rate).await?,
    }
    feed.settle().await
}

/// Sends the messages of a recording at the pace of their log times.
async fn send_recorded(feed: &mut Feed, recorded: &Recorded, rate: Rate) -> anyhow::Result<()> {
    let mut progress = Progress::new(recorded.statistics());
    let watch = Stopwatch::start();
    let mut first = None;
    for message in recorded.messages() {
        // What cannot be read was told before.
        let (Ok(bytes), Ok(Some(stamp))) = (message.cdr(), message.decode().map(|m| m.stamp()))
        else {
            continue;
        };
        match rate {
            Rate::Max => feed.has_room(stamp).await?,
            Rate::Times(times) => {
                let first = *first.get_or_insert(message.log_time);
                let passed = message.log_time.seconds_since(first).max(0.0);
                let due = Duration::try_from_secs_f64(passed / times).unwrap_or(Duration::MAX);
                sleep(due.saturating_sub(watch.elapsed().wall)).await;
            }
        }
        feed.send_recorded(message.topic.kind, stamp, bytes).await?;
        progress.advance(stamp);
    }
    progress.finish();
    Ok(())
}

async fn send_all(
    feed: &mut Feed,
    log: &CarmenLog,
    mut restamper: Option<&mut Restamper>,
    rate: Rate,
) -> anyhow::Result<()> {
    let mut progress = Progress::new(log.statistics());
    let watch = Stopwatch::start();
    let mut first_stamp = None;
    for reading in log.readings()? {
        let mut reading = reading?;
        if let Some(restamper) = &mut restamper {
            restamper.restamp(&mut reading);
        }
        match rate {
            Rate::Max => feed.has_room(reading.stamp).await?,
            Rate::Times(times) => {
                let first = *first_stamp.get_or_insert(reading.stamp);
                let due = Duration::from_secs_f64(reading.stamp.seconds_since(first) / times);
                sleep(due.saturating_sub(watch.elapsed().wall)).await;
            }
        }
        feed.send(&reading).await?;
        progress.advance(reading.stamp);
    }
    progress.finish();
    Ok(())
}

/// How many scans that were, and what became of them.
fn told(feed: &Feed, wall: Duration) -> String {
    let (sent, tally) = feed.tally();
    let mut text = format!("{sent} scans in {:.1} s", wall.as_secs_f64());
    for (verdict, count) in tally {
        text += &format!(", {count} {}", verdict.replace('_', " "));
    }
    if tally.contains_key("overload") {
        text += "\nthe daemon could not keep up: play slower, or with --rate max";
    }
    text
}
