//! `gmapd get`: what a robot knows, as text or as a file.

use std::io::{IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::error::ErrorKind;
use clap::{Args, ValueEnum};
use gmapd::files::write_atomically;

use super::mesh::{self, Answer};
use super::readable;
use super::session::SessionArguments;

/// Characters a line where nobody says how many there are.
const USUAL_COLUMNS: usize = 80;

/// What to ask whom, and where the answer goes.
#[derive(Debug, Args)]
#[command(after_help = "\
    Without ROBOT the only robot that is alive is asked; without WHAT its status.\n\
    The map is drawn to fit the terminal, by the environment variable COLUMNS or 80 wide.\n\
    With -o the ending says the format: .png .pgm .yaml .json .txt .cdr for maps, .tum .json .cdr\n\
    for paths, .json .cdr for the rest.\n\n\
    Examples:\n  \
        gmapd get                                      how the only robot is\n  \
        gmapd get robot01 map                          its map, drawn\n  \
        gmapd get robot01 map -o map.png               as a picture\n  \
        gmapd get robot01 path -o path.tum             for evo\n  \
        gmapd get robot01 pose --json -e tcp/192.168.1.5:7447\n\n\
    Exit codes: 0 answered, 1 nobody answered or the answer was an error, 2 wrong usage.")]
pub(crate) struct Arguments {
    /// Whom to ask: what the robot's keys begin with
    #[arg(value_name = "ROBOT")]
    first: Option<String>,
    /// What to ask for: status (default), map, pose, path, map_metadata, particlecloud or entropy
    #[arg(value_name = "WHAT")]
    second: Option<What>,
    /// File for the answer
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// How the answer is to be written, whatever the file is called
    #[arg(long, value_enum, value_name = "F")]
    format: Option<Format>,
    /// Print JSON; the same as --format json
    #[arg(long, conflicts_with = "format")]
    json: bool,
    #[command(flatten)]
    session: SessionArguments,
}

/// What a robot can be asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
enum What {
    Status,
    Map,
    Pose,
    Path,
    MapMetadata,
    Particlecloud,
    Entropy,
}

impl What {
    const fn key(self) -> &'static str {
        match self {
            Self::Status => "slam/status",
            Self::Map => "map",
            Self::Pose => "pose",
            Self::Path => "path",
            Self::MapMetadata => "map_metadata",
            Self::Particlecloud => "particlecloud",
            Self::Entropy => "entropy",
        }
    }
}

/// How an answer is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    Text,
    Json,
    Cdr,
    Png,
    Pgm,
    Yaml,
    Tum,
}

impl Format {
    fn by_ending(path: &Path) -> Option<Self> {
        let ending = path.extension()?.to_str()?;
        if ending == "txt" { Some(Self::Text) } else { Self::from_str(ending, false).ok() }
    }

    const fn name(self) -> &'static str {
        match self {
            Self::Text => "text",
            Self::Json => "json",
            Self::Cdr => "cdr",
            Self::Png => "png",
            Self::Pgm => "pgm",
            Self::Yaml => "yaml",
            Self::Tum => "tum",
        }
    }

    const fn is_binary(self) -> bool {
        matches!(self, Self::Cdr | Self::Png | Self::Pgm)
    }
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (robot, what) = whom_and_what(arguments);
    let format = format(arguments);
    let answer = mesh::block_on(async {
        let session = arguments.session.open().await?;
        let robot = mesh::choose(&session, robot).await?;
        let parameters = parameters(what, format);
        let answer = mesh::ask_robot(&session, &robot, (what.key(), &parameters)).await?;
        session.close().await.ok();
        Ok(answer)
    })?;
    let bytes = if format == Format::Text { as_text(what, answer) } else { answer.bytes };
    match &arguments.out {
        Some(path) => {
            write_atomically(path, &bytes)?;
            println!("{}: {} bytes", path.display(), bytes.len());
            Ok(())
        }
        None => print(&bytes),
    }
}

/// `gmapd get map` names no robot.
fn whom_and_what(arguments: &Arguments) -> (Option<&str>, What) {
    let first = arguments.first.as_deref();
    match (first.map(|word| What::from_str(word, false)), arguments.second) {
        (_, Some(what)) => (first, what),
        (Some(Ok(what)), None) => (None, what),
        (Some(Err(_)) | None, None) => (first, What::Status),
    }
}

fn format(arguments: &Arguments) -> Format {
    let Arguments { out, format, json, .. } = arguments;
    let chosen = match (format, json, out) {
        (Some(format), _, _) => *format,
        (None, true, _) => Format::Json,
        (None, false, None) => Format::Text,
        (None, false, Some(path)) => Format::by_ending(path).unwrap_or_else(|| {
            wrong_usage(&format!(
                "the ending of {} names no format (png, pgm, yaml, json, txt, cdr, tum); \
                 --format does",
                path.display()
            ))
        }),
    };
    if out.is_none() && chosen.is_binary() && std::io::stdout().is_terminal() {
        wrong_usage(&format!("{} is nothing for a terminal; name a file: -o FILE", chosen.name()));
    }
    chosen
}

fn wrong_usage(message: &str) -> ! {
    clap::Error::raw(ErrorKind::ValueValidation, format!("{message}\n")).exit()
}

/// What the daemon is asked, in the parameters of the selector.
fn parameters(what: What, format: Format) -> String {
    match (what, format) {
        // The status is always JSON.
        (What::Status, Format::Text | Format::Json) => String::new(),
        (What::Map, Format::Text) => format!("format=text;cols={}", columns()),
        (What::Path, Format::Text) => "format=tum".to_owned(),
        (_, Format::Text) => "format=json".to_owned(),
        (_, format) => format!("format={}", format.name()),
    }
}

fn columns() -> usize {
    let told = std::env::var("COLUMNS").ok().and_then(|text| text.parse().ok());
    told.filter(|&columns| columns > 0).unwrap_or(USUAL_COLUMNS)
}

/// The answer in words; what a newer daemon may answer that is not understood stays as it is.
fn as_text(what: What, answer: Answer) -> Vec<u8> {
    let text = match what {
        What::Status => readable::status(&answer),
        What::Pose => readable::pose(&answer),
        What::Particlecloud => readable::cloud(&answer),
        What::Entropy => readable::entropy(&answer),
        What::MapMetadata => readable::map_metadata(&answer),
        What::Map | What::Path => None,
    };
    text.map_or(answer.bytes, String::into_bytes)
}

fn print(bytes: &[u8]) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    out.write_all(bytes).context("cannot print the answer")?;
    if !bytes.ends_with(b"\n") && std::io::stdout().is_terminal() {
        writeln!(out).context("cannot print the answer")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Get {
        #[command(flatten)]
        arguments: Arguments,
    }

    fn get(words: &[&str]) -> Arguments {
        Get::try_parse_from([&["get"], words].concat()).unwrap().arguments
    }

    #[test]
    fn the_robot_and_what_to_ask_for_may_be_left_out() {
        let asked = |words: &[&str]| {
            let arguments = get(words);
            let (robot, what) = whom_and_what(&arguments);
            (robot.map(str::to_owned), what)
        };
        let robot = Some("robot01".to_owned());
        assert_eq!(asked(&[]), (None, What::Status));
        assert_eq!(asked(&["map_metadata"]), (None, What::MapMetadata));
        assert_eq!(asked(&["robot01"]), (robot.clone(), What::Status));
        assert_eq!(asked(&["robot01", "path"]), (robot, What::Path));
        assert_eq!(asked(&["map", "map"]), (Some("map".to_owned()), What::Map));
        assert!(Get::try_parse_from(["get", "robot01", "mapp"]).is_err());
    }

    #[test]
    fn the_ending_says_the_format_unless_an_option_does() {
        assert_eq!(format(&get(&["-o", "a/map.png"])), Format::Png);
        assert_eq!(format(&get(&["-o", "map.txt"])), Format::Text);
        assert_eq!(format(&get(&["-o", "map.png", "--format", "cdr"])), Format::Cdr);
        assert_eq!(format(&get(&["--json"])), Format::Json);
        assert_eq!(format(&get(&[])), Format::Text);
    }

    #[test]
    fn the_daemon_is_asked_for_what_it_has() {
        assert_eq!(parameters(What::Status, Format::Json), "");
        assert_eq!(parameters(What::Status, Format::Png), "format=png");
        assert_eq!(parameters(What::Path, Format::Text), "format=tum");
        assert_eq!(parameters(What::Pose, Format::Text), "format=json");
        assert!(parameters(What::Map, Format::Text).starts_with("format=text;cols="));
    }
}
