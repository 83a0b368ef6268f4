//! Joins a ROS 2 graph on DDS to a Zenoh mesh: a host of `zenoh-plugin-ros2dds`.
//!
//! It has the options of the stand-alone bridge that a robot needs.

use std::path::PathBuf;

use anyhow::{Context as _, anyhow};
use clap::Parser;
use serde_json::json;
use tokio::signal::unix::{SignalKind, signal};
use zenoh::internal::plugins::PluginsManager;
use zenoh::internal::runtime::{Runtime, RuntimeBuilder};
use zenoh_plugin_ros2dds::ROS2Plugin;

/// Joins a ROS 2 graph on DDS to a Zenoh mesh
#[derive(Debug, Parser)]
#[command(version)]
struct Arguments {
    /// Configuration of Zenoh and the plugin, JSON5; the arguments below come on top
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Connect there, as to tcp/192.168.1.5:7447; may be repeated
    #[arg(short = 'e', long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// Listen there, as on tcp/0.0.0.0:7447; may be repeated
    #[arg(short, long, value_name = "ENDPOINT")]
    listen: Vec<String>,
    /// What the robot's names begin with on the mesh, as in /robot01
    #[arg(short, long, value_name = "NAMESPACE")]
    namespace: Option<String>,
    /// DDS domain; ROS_DOMAIN_ID or 0 without
    #[arg(short, long, value_name = "ID")]
    domain: Option<u32>,
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    zenoh::init_log_from_env_or("warn,zenoh_plugin_ros2dds=info");
    let arguments = Arguments::parse();
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let runtime = start(&arguments).await?;
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
    runtime.close().await.map_err(|error| anyhow!("cannot end: {error}"))?;
    // The plugin's tasks panic when they are let go after their session.
    std::process::exit(0);
}

async fn start(arguments: &Arguments) -> anyhow::Result<Runtime> {
    let mut plugins = PluginsManager::static_plugins_only();
    plugins.declare_static_plugin::<ROS2Plugin, &str>("ros2dds", true);
    let mut runtime = RuntimeBuilder::new(configuration(arguments)?)
        .plugins_manager(plugins)
        .build()
        .await
        .map_err(|error| anyhow!("cannot start: {error}"))?;
    runtime.start().await.map_err(|error| anyhow!("cannot join the mesh: {error}"))?;
    Ok(runtime)
}

fn configuration(arguments: &Arguments) -> anyhow::Result<zenoh::Config> {
    let path = &arguments.config;
    let mut config = zenoh::Config::from_file(path)
        .map_err(|error| anyhow!("{error}"))
        .with_context(|| format!("cannot use {}", path.display()))?;
    // What the plugin needs of every session that hosts it.
    let mut settings = vec![
        ("timestamping/enabled", json!(true)),
        ("adminspace/enabled", json!(true)),
        ("plugins_loading/enabled", json!(true)),
    ];
    if !arguments.connect.is_empty() {
        settings.push(("connect/endpoints", json!(arguments.connect)));
    }
    if !arguments.listen.is_empty() {
        settings.push(("listen/endpoints", json!(arguments.listen)));
    }
    settings.extend(
        arguments.namespace.as_ref().map(|name| ("plugins/ros2dds/namespace", json!(name))),
    );
    settings.extend(arguments.domain.map(|id| ("plugins/ros2dds/domain", json!(id))));
    for (key, value) in settings {
        config
            .insert_json5(key, &value.to_string())
            .map_err(|error| anyhow!("{key} cannot be {value}: {error}"))?;
    }
    Ok(config)
}
