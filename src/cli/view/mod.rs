//! `gmapd view`: robots and their maps in a browser.

mod guard;
mod page;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context as _;
use axum::extract::{Json, Path, Query, Request, State, WebSocketUpgrade};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::{get, post};
use clap::Args;
use gmapd::daemon::keys::Prefix;
use serde::Deserialize;
use tokio::net::TcpListener;
use zenoh::Session;

use self::guard::Guard;
use super::mesh;
use super::session::SessionArguments;

/// Where the mesh is, and where the page is to be.
#[derive(Debug, Args)]
#[command(after_help = "\
    Open the address that is printed. On other addresses than this machine's own, anybody who\n\
    reaches it has to know the token that is printed with it.\n\n\
    Examples:\n  \
        gmapd view\n  \
        gmapd view -e tcp/192.168.1.5:7447 --listen 0.0.0.0:8080\n\n\
    Exit codes: 0 ended by Ctrl-C, 1 failed, 2 wrong usage.")]
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
        let serving = serve(*listen, session.clone()).await?;
        tokio::select! {
            ended = serving => ended?,
            signal = tokio::signal::ctrl_c() => signal.context("cannot wait for Ctrl-C")?,
        }
        session.close().await.ok();
        Ok(())
    })
}

/// Listens and prints the address; the future that it returns serves.
pub(super) async fn serve(
    listen: SocketAddr,
    session: Session,
) -> anyhow::Result<impl Future<Output = anyhow::Result<()>>> {
    let listener = TcpListener::bind(listen).await;
    let listener = listener.with_context(|| format!("cannot listen on {listen}"))?;
    let address = listener.local_addr().context("the page has no address")?;
    let guard = Guard::of(address.ip()).context("cannot make a token")?;
    println!("http://{address}/{}", guard.suffix());
    let router = router(Arc::new(Site { session, guard }));
    Ok(async move { axum::serve(listener, router).await.context("cannot serve the page") })
}

/// What all requests share.
struct Site {
    session: Session,
    guard: Guard,
}

#[derive(Deserialize)]
struct Whom {
    robot: Option<String>,
}

fn router(site: Arc<Site>) -> axum::Router {
    let guarded = middleware::from_fn_with_state(site.clone(), guarded);
    axum::Router::new()
        .route("/socket", get(socket))
        .route("/map/{format}", get(map))
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
    let robot = match whom.robot.as_deref().map(Prefix::parse).transpose() {
        Ok(robot) => robot,
        Err(error) => return (StatusCode::BAD_REQUEST, error.to_string()).into_response(),
    };
    let session = site.session.clone();
    upgrade.on_upgrade(move |socket| page::talk(socket, session, robot))
}

async fn map(
    State(site): State<Arc<Site>>,
    Path(format): Path<String>,
    Query(whom): Query<Whom>,
) -> Response {
    if !["png", "pgm", "yaml"].contains(&format.as_str()) {
        let reason = format!("a map is png, pgm or yaml, not {format:?}");
        return (StatusCode::NOT_FOUND, reason).into_response();
    }
    let question = ("map", format!("format={format}"));
    match asked(&site, &whom, (question.0, &question.1)).await {
        Ok(bytes) => {
            let name = format!("attachment; filename=\"map.{format}\"");
            ([(header::CONTENT_DISPOSITION, name)], bytes).into_response()
        }
        Err(error) => (StatusCode::BAD_GATEWAY, format!("{error:#}")).into_response(),
    }
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
    let robot = Prefix::parse(whom.robot.as_deref().context("no robot is named")?)?;
    Ok(mesh::ask_robot(&site.session, &robot, question).await?.bytes)
}
