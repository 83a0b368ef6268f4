//! How a subcommand gets onto the mesh.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow};
use clap::Args;
use gmapd::daemon::keys::plain_message;

/// Above it, a message is dropped piece by piece; Zenoh's own is 1 GiB.
const MAX_MESSAGE: &str = "transport/link/rx/max_message_size";

/// Files that Zenoh's configuration names.
const SECRETS: [&str; 6] = [
    "transport/auth/usrpwd/dictionary_file",
    "transport/link/tls/root_ca_certificate",
    "transport/link/tls/listen_certificate",
    "transport/link/tls/listen_private_key",
    "transport/link/tls/connect_certificate",
    "transport/link/tls/connect_private_key",
];

/// Where the mesh is.
///
/// Without arguments the session is a peer that finds others on the local network.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Mesh")]
pub(crate) struct SessionArguments {
    /// Zenoh's configuration, JSON5; the two arguments below come on top
    #[arg(long, value_name = "FILE")]
    zenoh: Option<PathBuf>,
    /// Connect as a client, as to tcp/192.168.1.5:7447 (with --listen as a peer); may be repeated
    #[arg(short = 'e', long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// Listen there as a peer, as on tcp/0.0.0.0:7447; may be repeated
    #[arg(short, long, value_name = "ENDPOINT")]
    listen: Vec<String>,
}

impl SessionArguments {
    /// Connects only; for who has another use for `--listen`.
    pub(crate) const fn connecting(zenoh: Option<PathBuf>, connect: Vec<String>) -> Self {
        Self { zenoh, connect, listen: Vec::new() }
    }

    /// Opens the session; nobody answering at `--connect` is an error.
    ///
    /// Zenoh needs tokio's multi-thread runtime.
    pub(crate) async fn open(&self) -> anyhow::Result<zenoh::Session> {
        self.open_with(self.config()?).await
    }

    /// Opens the session as soon as one of `--connect` answers, however long that takes. Messages
    /// of more bytes than this are dropped before they are whole, unless the file says how many.
    pub(crate) async fn open_when_reachable(&self, most: usize) -> anyhow::Result<zenoh::Session> {
        let mut config = self.config()?;
        if !self.connect.is_empty() {
            insert(&mut config, "connect/timeout_ms", "-1")?;
        }
        let told = config.get_json(MAX_MESSAGE).map_err(|error| anyhow!(plain_message(&error)))?;
        if zenoh::Config::default().get_json(MAX_MESSAGE).is_ok_and(|default| default == told) {
            insert(&mut config, MAX_MESSAGE, &most.to_string())?;
        }
        self.open_with(config).await
    }

    /// What `--connect` says, for messages.
    pub(crate) fn endpoints(&self) -> &[String] {
        &self.connect
    }

    async fn open_with(&self, config: zenoh::Config) -> anyhow::Result<zenoh::Session> {
        zenoh::open(config).await.map_err(|error| {
            let error = anyhow!(plain_message(&error));
            if self.connect.is_empty() {
                error.context("cannot open a Zenoh session")
            } else {
                error.context(format!(
                    "cannot open a Zenoh session; does anybody listen at {}, and let us in?",
                    self.connect.join(", ")
                ))
            }
        })
    }

    fn config(&self) -> anyhow::Result<zenoh::Config> {
        let mut config = match &self.zenoh {
            Some(path) => with_secrets(path)
                .with_context(|| format!("cannot use Zenoh's configuration {}", path.display()))?,
            None => zenoh::Config::default(),
        };
        if !self.connect.is_empty() {
            insert(&mut config, "connect/endpoints", &json(&self.connect)?)?;
            // Two peers that share only a router do not hear each other; clients do.
            insert(&mut config, "mode", "\"client\"")?;
        }
        if !self.listen.is_empty() {
            insert(&mut config, "listen/endpoints", &json(&self.listen)?)?;
            insert(&mut config, "mode", "\"peer\"")?;
        }
        Ok(config)
    }
}

/// Zenoh's configuration from a file. The files of keys and passwords that it names are looked for
/// here, as Zenoh does, and beside it; Zenoh itself tells nobody that one is missing.
fn with_secrets(path: &Path) -> anyhow::Result<zenoh::Config> {
    let plain = |error: zenoh::Error| anyhow!(plain_message(&error));
    let mut config = zenoh::Config::from_file(path).map_err(plain)?;
    for key in SECRETS {
        let value = config.get_json(key).map_err(plain)?;
        let Some(named) = serde_json::from_str::<Option<PathBuf>>(&value)? else { continue };
        let beside = path.parent().unwrap_or(Path::new("")).join(&named);
        let found = [&named, &beside].into_iter().find(|file| file.exists());
        let found =
            found.with_context(|| format!("{key}: there is no file {}", beside.display()))?;
        File::open(found).with_context(|| format!("{key}: cannot read {}", found.display()))?;
        insert(&mut config, key, &serde_json::to_string(found)?)?;
    }
    Ok(config)
}

fn json(endpoints: &[String]) -> anyhow::Result<String> {
    serde_json::to_string(endpoints).context("endpoints are text")
}

fn insert(config: &mut zenoh::Config, key: &str, value: &str) -> anyhow::Result<()> {
    config
        .insert_json5(key, value)
        .map_err(|error| anyhow!("Zenoh does not take {value} as {key}: {}", plain_message(&error)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(connect: &[&str], listen: &[&str]) -> anyhow::Result<zenoh::Config> {
        let texts = |texts: &[&str]| texts.iter().map(|&text| text.to_owned()).collect();
        SessionArguments { zenoh: None, connect: texts(connect), listen: texts(listen) }.config()
    }

    #[test]
    fn connecting_makes_a_client_and_listening_a_peer() {
        let mode = |connect: &[&str], listen: &[&str]| {
            config(connect, listen).unwrap().get_json("mode").unwrap()
        };
        assert_eq!(mode(&["tcp/127.0.0.1:7447"], &[]), "\"client\"");
        assert_eq!(mode(&[], &["tcp/127.0.0.1:0"]), "\"peer\"");
        assert_eq!(mode(&["tcp/127.0.0.1:7447"], &["tcp/127.0.0.1:0"]), "\"peer\"");
    }

    #[test]
    fn endpoints_are_those_that_were_given() {
        let config = config(&["tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447"], &[]).unwrap();
        let endpoints = config.get_json("connect/endpoints").unwrap();
        assert_eq!(endpoints, r#"["tcp/10.0.0.1:7447","tcp/10.0.0.2:7447"]"#);
    }

    #[test]
    fn files_of_keys_are_found_beside_the_configuration_or_named() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("robot.json5");
        let text = r#"{ transport: { link: { tls: { root_ca_certificate: "ca/a.pem" } } } }"#;
        std::fs::write(&path, text).unwrap();
        let error = format!("{:#}", with_secrets(&path).unwrap_err());
        assert!(error.starts_with("transport/link/tls/root_ca_certificate: there is no file /"));
        assert!(error.ends_with("ca/a.pem"), "{error}");
        std::fs::create_dir(directory.path().join("ca")).unwrap();
        let authority = directory.path().join("ca/a.pem");
        std::fs::write(&authority, "").unwrap();
        let used = with_secrets(&path).unwrap().get_json(SECRETS[1]).unwrap();
        assert_eq!(used, serde_json::to_string(&authority).unwrap());
    }

    #[test]
    fn what_is_no_endpoint_is_named() {
        let error = format!("{:#}", config(&["router"], &[]).unwrap_err());
        assert!(error.contains(r#"["router"]"#), "{error}");
    }
}
