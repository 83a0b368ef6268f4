//! `gmapd view`: robots and their maps in a browser.

mod fleet;
mod guard;
mod page;
mod robot;

use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, anyhow, ensure};
use axum::extract::{Json, Path, Query, Request, State, WebSocketUpgrade};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::{get, post};
use clap::Args;
use gmapd::daemon::keys::Prefix;
use gmapd::map;
use serde::Deserialize;
use tokio::net::TcpListener;
use tokio::time::timeout;
use zenoh::Session;

use self::fleet::Fleet;
use self::guard::Guard;
use super::mesh::{self, Outcome};
use super::session::SessionArguments;
use super::signals::Signals;

/// A robot saves, and a large map comes through a slow network, in less.
const LONGEST_ANSWER: Duration = Duration::from_secs(60);

/// Where the mesh is, and where the page is to be.
#[derive(Debug, Args)]
#[command(after_help = "\
    Open the address that is printed: it shows the robots that are alive, and of one of them the\n\
    map as it grows, pose, scan, path and particles, and why the map does not grow. Set the pose,\n\
    pause, reset and save there, measure distances, and download the map.\n\n\
    Only this machine gets in, unless --listen says otherwise. Then anybody who reaches the\n\
    address has to know the token in it, which is new at each start; there is no encryption, so\n\
    in a network that is not yours, take ssh -L 8080:127.0.0.1:8080 instead.\n\n\
    Examples:\n  \
        gmapd view\n  \
        gmapd view -e tcp/192.168.1.5:7447\n  \
        gmapd view --listen 0.0.0.0:8080      for a phone: open the address that is printed\n\n\
    Exit codes: 0 ended by a signal, 1 failed, 2 wrong usage.")]
pub(crate) struct Arguments {
    /// Address and port of the page; port 0 is any that is free
    #[arg(short, long, value_name = "ADDRESS", default_value = "127.0.0.1:8080")]
    listen: SocketAddr,
    /// Zenoh's configuration, JSON5
    #[arg(long, value_name = "FILE")]
    zenoh: Option<PathBuf>,
    /// Connect as a client, as to tcp/192.168.1.5:7447; may be repeated
    #[arg(short = 'e', long, value_name = "ENDPOINT")]
    connect: Vec<String>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments { listen, zenoh, connect } = arguments;
    mesh::block_on(async {
        let mesh = SessionArguments::connecting(zenoh.clone(), connect.clone());
        let session = mesh.open().await?;
        let mut signals = Signals::listen()?;
        let page = Page::open(*listen, session.clone()).await?;
        println!("{}", page.address);
        tokio::select! {
            ended = page.serve() => ended?,
            () = signals.next() => {}
        }
        session.close().await.ok();
        Ok(())
    })
}

/// A server that listens.
pub(super) struct Page {
    listener: TcpListener,
    site: Site,
    /// What to open, with the token if there is one.
    pub(super) address: String,
}

impl Page {
    /// Listens to requests and to the mesh.
    pub(super) async fn open(listen: SocketAddr, session: Session) -> anyhow::Result<Self> {
        let listener = TcpListener::bind(listen).await.with_context(|| {
            format!("cannot listen on {listen}; --listen 127.0.0.1:0 takes a port that is free")
        })?;
        let bound = listener.local_addr().context("the page has no address")?;
        let guard = Guard::of(bound.ip()).context("cannot make a token")?;
        let reached = SocketAddr::new(reached_as(bound.ip()), bound.port());
        let address = format!("http://{reached}/{}", guard.suffix());
        let fleet = Arc::new(Fleet::of(session).await?);
        Ok(Self { listener, site: Site { fleet, guard }, address })
    }

    /// Answers requests; does not end by itself.
    pub(super) async fn serve(self) -> anyhow::Result<()> {
        let router = router(Arc::new(self.site));
        axum::serve(self.listener, router).await.context("cannot serve the page")
    }
}

/// By which address others reach a server that listens on all: that of the way out.
fn reached_as(bound: IpAddr) -> IpAddr {
    if !bound.is_unspecified() {
        return bound;
    }
    // Nothing is sent: the socket only learns its own address. The other is for documentation.
    let way_out = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).and_then(|socket| {
        socket.connect((Ipv4Addr::new(192, 0, 2, 1), 9))?;
        socket.local_addr()
    });
    way_out.map_or(IpAddr::V4(Ipv4Addr::LOCALHOST), |address| address.ip())
}

/// What all requests share.
struct Site {
    fleet: Arc<Fleet>,
    guard: Guard,
}

#[derive(Deserialize)]
struct Whom {
    robot: Option<String>,
}

impl Whom {
    fn robot(&self) -> anyhow::Result<Prefix> {
        Ok(Prefix::parse(self.robot.as_deref().context("no robot is named")?)?)
    }
}

fn router(site: Arc<Site>) -> axum::Router {
    let guarded = middleware::from_fn_with_state(site.clone(), guarded);
    axum::Router::new()
        .route("/socket", get(socket))
        .route("/map/{format}", get(download))
        .route("/command/{name}", post(command))
        .route_layer(guarded)
        .route("/", get(|| async { Html(include_str!("index.html")) }))
        .route("/view.css", get(|| asset("text/css", include_str!("view.css"))))
        .route("/view.js", get(|| asset("text/javascript", include_str!("view.js"))))
        .layer(middleware::map_response(hardened))
        .with_state(site)
}

async fn asset(kind: &'static str, text: &'static str) -> Response {
    ([(header::CONTENT_TYPE, kind)], text).into_response()
}

/// The page runs nothing but its own, and in nobody's frame.
async fn hardened(mut response: Response) -> Response {
    let headers = response.headers_mut();
    let policy = "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'";
    headers.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(policy));
    headers.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    response
}

async fn guarded(State(site): State<Arc<Site>>, request: Request, next: Next) -> Response {
    let query = request.uri().query().unwrap_or_default();
    match site.guard.check(request.method(), request.headers(), query) {
        Ok(()) => next.run(request).await,
        Err(refusal) => (StatusCode::FORBIDDEN, refusal.to_string()).into_response(),
    }
}

async fn socket(
    State(site): State<Arc<Site>>,
    Query(whom): Query<Whom>,
    upgrade: WebSocketUpgrade,
) -> Response {
    // No robot has a name that is none.
    let robot = whom.robot.as_deref().and_then(|name| Prefix::parse(name).ok());
    let fleet = site.fleet.clone();
    upgrade.on_upgrade(move |socket| page::talk(socket, fleet, robot))
}

async fn download(
    State(site): State<Arc<Site>>,
    Path(format): Path<String>,
    Query(whom): Query<Whom>,
) -> Response {
    let file = match format.as_str() {
        "png" => picture(&site, &whom).await,
        "pgm" | "yaml" => file_of_map(&site, &whom, &format).await,
        _ => {
            let reason = format!("a map is png, pgm or yaml, not {format:?}");
            return (StatusCode::NOT_FOUND, reason).into_response();
        }
    };
    match file {
        Ok((name, bytes)) => {
            let name = format!("attachment; filename=\"{name}\"");
            ([(header::CONTENT_DISPOSITION, name)], bytes).into_response()
        }
        Err(error) => (StatusCode::BAD_GATEWAY, format!("{error:#}")).into_response(),
    }
}

/// Name and bytes of a file.
type Download = (String, Vec<u8>);

async fn picture(site: &Site, whom: &Whom) -> anyhow::Result<Download> {
    let bytes = asked(site, whom, ("map", "format=png")).await?;
    Ok((format!("{}.png", file_stem(&whom.robot()?)), bytes))
}

/// The map that pages show. The picture and what goes with it are asked for one after the other:
/// both have the version in their names, and the one names the other.
async fn file_of_map(site: &Site, whom: &Whom, format: &str) -> anyhow::Result<Download> {
    let robot = whom.robot()?;
    // Whoever is not there is told of at once.
    asked(site, whom, ("map_metadata", "")).await?;
    let watched = site.fleet.watch(&robot).await?;
    let mut states = watched.mirror.states();
    let whole = timeout(LONGEST_ANSWER, states.wait_for(|state| state.is_newest)).await;
    let map = whole.map_err(|_elapsed| silence(&robot, "slam/tiles"))??.map.clone();
    let grid = map.grid();
    ensure!(!grid.cells.is_empty(), "there is no map yet");
    let stem = format!("{}-v{}", file_stem(&robot), map.version());
    let image = format!("{stem}.pgm");
    if format == "pgm" {
        return Ok((image, map::pgm(&grid)));
    }
    Ok((format!("{stem}.yaml"), map::yaml(&grid, &image).into_bytes()))
}

/// A robot's name as one of a file.
fn file_stem(robot: &Prefix) -> String {
    let name = robot.to_string();
    let allowed = |letter: char| letter.is_ascii_alphanumeric() || "-_.".contains(letter);
    let name = name.replace(|letter| !allowed(letter), "-");
    if name.is_empty() { "map".to_owned() } else { name }
}

/// Parameters of a command; those that it does not know the daemon refuses.
#[derive(Deserialize)]
struct Parameters {
    #[serde(default)]
    x: Option<f64>,
    #[serde(default)]
    y: Option<f64>,
    #[serde(default)]
    yaw: Option<f64>,
}

async fn command(
    State(site): State<Arc<Site>>,
    Path(name): Path<String>,
    Query(whom): Query<Whom>,
    Json(parameters): Json<Parameters>,
) -> Response {
    if !["reset", "pause", "resume", "initial_pose", "save"].contains(&name.as_str()) {
        return (StatusCode::NOT_FOUND, format!("there is no command {name:?}")).into_response();
    }
    let Parameters { x, y, yaw } = parameters;
    let given = [("x", x), ("y", y), ("yaw", yaw)];
    let given = given.into_iter().filter_map(|(name, value)| Some(format!("{name}={}", value?)));
    let given = given.collect::<Vec<_>>().join(";");
    match asked(&site, &whom, (&format!("slam/cmd/{name}"), &given)).await {
        Ok(bytes) => ([(header::CONTENT_TYPE, "application/json")], bytes).into_response(),
        Err(error) => (StatusCode::BAD_GATEWAY, format!("{error:#}")).into_response(),
    }
}

async fn asked(site: &Site, whom: &Whom, question: (&str, &str)) -> anyhow::Result<Vec<u8>> {
    let robot = whom.robot()?;
    let selector = mesh::selector(&robot, question)?;
    match mesh::ask_within(site.fleet.session(), &selector, LONGEST_ANSWER).await? {
        Outcome::Answered(answer) => Ok(answer.bytes),
        Outcome::Silence => Err(silence(&robot, question.0)),
        Outcome::Nobody => Err(mesh::nobody_answers(&robot, question.0, &site.fleet.alive())),
    }
}

fn silence(robot: &Prefix, name: &str) -> anyhow::Error {
    let (robot, limit) = (mesh::name(robot), LONGEST_ANSWER.as_secs());
    anyhow!("{robot} gave no answer to {name} within {limit} s")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn robots_names_become_those_of_files() {
        let stem = |name| file_stem(&Prefix::parse(name).unwrap());
        assert_eq!(stem("robot01"), "robot01");
        assert_eq!(stem("site/robot.1"), "site-robot.1");
        assert_eq!(stem(""), "map");
    }
}
