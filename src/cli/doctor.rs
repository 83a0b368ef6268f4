//! `gmapd doctor`: watches a robot's input for a while and says what is wrong.

use std::io::Write as _;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context as _, anyhow, bail};
use clap::Args;
use gmapd::clock;
use gmapd::daemon::keys::Prefix;
use gmapd::doctor::{FrameNames, Input, Keys, Report, Watch};
use gmapd::slam::pose::Stamp;
use serde_json::Value;
use zenoh::Session;
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt as _, HistoryConfig};

use super::mesh;
use super::session::SessionArguments;

/// Whom to watch, and for how long.
#[derive(Debug, Args)]
#[command(after_help = "\
    Watches scan, odom, tf and tf_static and asks the daemon how it is. Drive the robot meanwhile,\n\
    and turn it by half a circle or more: only then scans can be compared with odometry.\n\
    It sees robots without a daemon too, if they are named.\n\n\
    Examples:\n  \
        gmapd doctor robot01\n  \
        gmapd doctor robot01 --seconds 30 -e tcp/192.168.1.5:7447\n  \
        gmapd doctor robot01 --base-frame base_footprint\n\n\
    Exit codes: 0 healthy, 1 something is wrong, 2 wrong usage.")]
pub(crate) struct Arguments {
    /// Whom to watch: what the robot's keys begin with; without, the only robot that is alive
    robot: Option<String>,
    /// Seconds to watch
    #[arg(long, value_name = "S", default_value = "10", value_parser = clap::value_parser!(u64).range(1..=600))]
    seconds: u64,
    /// Frame of the robot, as in its configuration
    #[arg(long, value_name = "FRAME", default_value = "base_link")]
    base_frame: String,
    /// Frame of odometry, as in its configuration
    #[arg(long, value_name = "FRAME", default_value = "odom")]
    odom_frame: String,
    #[command(flatten)]
    session: SessionArguments,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let report = mesh::block_on(watch(arguments))?;
    let text = readable(&report);
    std::io::stdout().lock().write_all(text.as_bytes()).context("cannot print the report")?;
    match report.findings.len() {
        0 => Ok(()),
        1 => bail!("one thing is wrong"),
        count => bail!("{count} things are wrong"),
    }
}

async fn watch(arguments: &Arguments) -> anyhow::Result<Report> {
    let session = arguments.session.open().await?;
    let robot = mesh::choose(&session, arguments.robot.as_deref()).await?;
    let keys = keys(&session, &robot).await?;
    let names =
        FrameNames { odom: arguments.odom_frame.clone(), base: arguments.base_frame.clone() };
    let watch = Arc::new(Mutex::new(Watch::new(keys.clone(), names)));
    let subscribers = subscribe(&session, &keys, &watch).await?;
    let seconds = arguments.seconds;
    eprintln!("watching {} for {seconds} s; drive and turn the robot", mesh::name(&robot));
    tokio::time::sleep(Duration::from_secs(seconds)).await;
    drop(subscribers);
    let status = mesh::ask(&session, &keys.status).await?;
    session.close().await.ok();
    let mut watch = watch.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(status) = status {
        watch.add_status(&status.bytes);
    }
    Ok(watch.report())
}

/// The daemon knows under which keys it listens; without one, those of the defaults.
async fn keys(session: &Session, robot: &Prefix) -> anyhow::Result<Keys> {
    let status = robot.key("slam/status")?.to_string();
    let answer = mesh::ask(session, &status).await?;
    let told: Value =
        answer.and_then(|answer| serde_json::from_slice(&answer.bytes).ok()).unwrap_or_default();
    let mut inputs = Input::ALL.map(|input| input.name().to_owned());
    for (key, input) in inputs.iter_mut().zip(Input::ALL) {
        *key = match told["inputs"][input.name()]["key"].as_str() {
            Some(key) => key.to_owned(),
            None => robot.key(input.name())?.to_string(),
        };
    }
    Ok(Keys { inputs, status })
}

/// With what publishers of static transforms have kept.
async fn subscribe(
    session: &Session,
    keys: &Keys,
    watch: &Arc<Mutex<Watch>>,
) -> anyhow::Result<Vec<AdvancedSubscriber<()>>> {
    let mut subscribers = Vec::new();
    for (input, key) in Input::ALL.into_iter().zip(&keys.inputs) {
        let watch = Arc::clone(watch);
        let subscriber = session
            .declare_subscriber(key.clone())
            .callback(move |sample| {
                let arrival = Stamp(clock::unix_nanoseconds());
                let (payload, encoding) =
                    (sample.payload().to_bytes(), sample.encoding().to_string());
                let mut watch = watch.lock().unwrap_or_else(PoisonError::into_inner);
                watch.add(input, arrival, (&payload, &encoding));
            })
            .history(HistoryConfig::default().detect_late_publishers().max_samples(100))
            .await
            .map_err(|error| anyhow!(error))
            .with_context(|| format!("cannot subscribe to {key}"))?;
        subscribers.push(subscriber);
    }
    Ok(subscribers)
}

fn readable(report: &Report) -> String {
    let mut text = String::new();
    for fact in &report.facts {
        text += &format!("seen    {fact}\n");
    }
    for finding in &report.findings {
        text += &format!("WRONG   {finding}\n        remedy: {}\n", finding.remedy());
    }
    if report.findings.is_empty() {
        text += "healthy\n";
    }
    text
}
