//! `gmapd view` as a browser meets it: the real program, daemons that it shows, and Chromium.

mod browser;
mod http;
#[path = "../processes/mod.rs"]
mod processes;

use std::fs;
use std::net::TcpStream;
use std::path::PathBuf;

use gmapd::map;
use gmapd::map::mirror::Mirror;
use serde_json::{Value, json};
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use self::browser::{Browser, Mouse};
use self::http::{Answer, get, post};
use self::processes::{Background, Daemon, PATIENCE, directory, program, simulated_log};
use self::processes::{succeed, text};

/// `gmapd view` of a daemon's mesh.
struct View {
    background: Background,
    /// As it is printed.
    url: String,
}

impl View {
    fn of(daemon: &Daemon, listen: &str) -> Self {
        let mut command = program();
        command.args(["view", "-e", &daemon.endpoint, "--listen", listen]);
        let background = Background::start(&mut command);
        let url = background.line_with("http://");
        Self { background, url }
    }

    fn on_loopback(daemon: &Daemon) -> Self {
        Self::of(daemon, "127.0.0.1:0")
    }

    /// Address and port.
    fn host(&self) -> &str {
        let rest = self.url.strip_prefix("http://").expect("it is an address");
        rest.split_once('/').expect("it ends with a path").0
    }

    fn token(&self) -> &str {
        self.url.split_once("?token=").expect("it has a token").1
    }

    fn get(&self, path: &str) -> Answer {
        get(self.host(), path, &[])
    }

    /// A command from the page itself.
    fn command(&self, name: &str, body: &Value) -> Answer {
        let path = format!("/command/{name}?robot=robot01");
        post(self.host(), &path, &[("x-gmapd-token", "")], body)
    }

    fn socket(&self, query: &str) -> tungstenite::Result<Socket> {
        let (socket, _) = tungstenite::connect(format!("ws://{}/socket{query}", self.host()))?;
        if let MaybeTlsStream::Plain(stream) = socket.get_ref() {
            stream.set_read_timeout(Some(PATIENCE))?;
        }
        Ok(Socket(socket))
    }
}

struct Socket(WebSocket<MaybeTlsStream<TcpStream>>);

impl Socket {
    fn message(&mut self) -> Message {
        http::message(&mut self.0).expect("another message comes")
    }

    /// The next value of a kind for which this holds.
    fn wait(&mut self, kind: &str, holds: impl Fn(&Value) -> bool) -> Value {
        loop {
            let Message::Text(text) = self.message() else { continue };
            let mut news: Value = serde_json::from_str(&text).expect("text is JSON");
            if news.get(kind).is_some_and(&holds) {
                return news[kind].take();
            }
        }
    }
}

/// A daemon that has mapped a corridor.
fn mapped() -> Daemon {
    let directory = directory();
    let daemon = Daemon::start("robot01");
    let log = simulated_log(&directory);
    daemon.play(&[text(&log), "--prefix", "robot01", "--rate", "max"]);
    daemon
}

fn status(daemon: &Daemon) -> Value {
    let file = directory();
    let path = file.path().join("status.json");
    succeed(&["get", "-e", &daemon.endpoint, "robot01", "status", "-o", text(&path)]);
    let status = fs::read(&path).expect("it was written");
    serde_json::from_slice(&status).expect("a status is JSON")
}

#[test]
fn the_page_is_whole_and_runs_nothing_but_its_own() {
    let daemon = Daemon::start("robot01");
    let mut view = View::on_loopback(&daemon);
    for (path, kind, word) in [
        ("/", "text/html", "<canvas"),
        ("/view.css", "text/css", "prefers-color-scheme: dark"),
        ("/view.js", "text/javascript", "new WebSocket"),
    ] {
        let answer = view.get(path);
        assert_eq!(answer.status, 200, "{path}");
        assert!(answer.header("content-type").starts_with(kind), "{}", answer.head);
        assert!(answer.header("content-security-policy").starts_with("default-src 'self'"));
        assert!(answer.text().contains(word), "{path}");
        let others = answer.text().matches("://").count();
        assert_eq!(others, 0, "{path} has everything with it");
    }
    assert_eq!(view.get("/nothing").status, 404);
    view.background.interrupt();
    assert_eq!(view.background.exit_code(), Some(0));
}

#[test]
fn maps_are_downloaded_as_the_robot_has_them() {
    let daemon = mapped();
    let view = View::on_loopback(&daemon);
    let directory = directory();
    let version = status(&daemon)["map"]["version"].clone();
    for format in ["png", "pgm", "yaml"] {
        let answer = view.get(&format!("/map/{format}?robot=robot01"));
        assert_eq!(answer.status, 200, "{}", answer.text());
        let stem = if format == "png" { "robot01" } else { &format!("robot01-v{version}") };
        let name = format!("attachment; filename=\"{stem}.{format}\"");
        assert_eq!(answer.header("content-disposition"), name);
        let path: PathBuf = directory.path().join(format!("map.{format}"));
        succeed(&["get", "-e", &daemon.endpoint, "robot01", "map", "-o", text(&path)]);
        let mut expected = fs::read(&path).expect("it was written");
        if format == "yaml" {
            // It names the picture that goes with it.
            let text = String::from_utf8(expected).expect("it is text");
            expected = text.replace("map.pgm", &format!("{stem}.pgm")).into_bytes();
        }
        assert_eq!(answer.body, expected, "{format}");
    }
    assert_eq!(view.get("/map/exe?robot=robot01").status, 404);
    for format in ["png", "pgm"] {
        let answer = view.get(&format!("/map/{format}?robot=robot02"));
        assert_eq!(answer.status, 502);
        assert!(answer.text().contains("alive are: robot01"), "{}", answer.text());
    }
}

#[test]
fn a_page_that_is_told_nothing_is_asked_whether_it_is_there() {
    let daemon = Daemon::start("robot01");
    let view = View::on_loopback(&daemon);
    let mut socket = view.socket("").expect("it is let in");
    while !matches!(socket.message(), Message::Ping(_)) {}
}

#[test]
fn the_demo_shows_its_page() {
    let directory = directory();
    let mut command = program();
    command.args(["demo", "--view", "--seconds", "5"]).current_dir(directory.path());
    let mut demo = Background::start(&mut command);
    let line = demo.line_with("look at it: http://");
    let url = line.split_once(": ").expect("it ends with an address").1.to_owned();
    let view = View { background: demo, url };
    assert!(view.get("/").text().contains("<canvas"));
    let mut socket = view.socket("?robot=robot01").expect("it is let in");
    socket.wait("pose", |pose| pose["x"].is_number());
    view.background.line_with("the page is there until Ctrl-C");
    assert_eq!(view.get("/").status, 200);
    demo = view.background;
    demo.interrupt();
    assert_eq!(demo.exit_code(), Some(0));
    assert!(directory.path().join("demo/map.pgm").exists());
}

#[test]
fn commands_are_taken_from_the_own_page_alone() {
    let daemon = Daemon::start("robot01");
    let view = View::on_loopback(&daemon);
    let nothing = json!({});
    let path = "/command/pause?robot=robot01";
    let refused = |headers: &[(&str, &str)]| {
        let answer = post(view.host(), path, headers, &nothing);
        assert_eq!(answer.status, 403, "{headers:?}: {}", answer.text());
        answer.text().to_owned()
    };
    let own = ("x-gmapd-token", "");
    assert!(refused(&[]).contains("needs the header"));
    assert!(refused(&[own, ("origin", "http://evil.org")]).contains("other origins"));
    assert!(refused(&[own, ("sec-fetch-site", "cross-site")]).contains("other origins"));
    assert!(refused(&[own, ("host", "evil.org")]).contains("for this machine"));
    assert_eq!(view.get(path).status, 405);
    assert_eq!(view.command("format_disk", &nothing).status, 404);
    assert_ne!(status(&daemon)["state"], "paused", "nothing of this was done");

    let answer = view.command("pause", &nothing);
    assert_eq!(answer.status, 200, "{}", answer.text());
    assert_eq!(answer.json()["changed"], true);
    assert_eq!(status(&daemon)["state"], "paused");
    let answer = view.command("initial_pose", &json!({ "x": 1.0 }));
    assert_eq!(answer.status, 502);
    assert!(answer.text().contains('y'), "the daemon says what is missing: {}", answer.text());
}

#[test]
fn elsewhere_than_on_loopback_the_token_opens_everything_and_nothing_else_does() {
    let daemon = Daemon::start("robot01");
    let view = View::of(&daemon, "0.0.0.0:0");
    let other = View::of(&daemon, "0.0.0.0:0");
    assert_eq!(view.token().len(), 32);
    assert_ne!(view.token(), other.token());
    let path = "/map/yaml?robot=robot01";
    for token in ["", &view.token()[1..], other.token()] {
        let answer = view.get(&format!("{path}&token={token}"));
        assert_eq!(answer.status, 403);
        assert!(answer.text().contains("token"), "{}", answer.text());
        assert!(view.socket(&format!("?token={token}")).is_err());
        let headers = [("x-gmapd-token", token)];
        let answer = post(view.host(), "/command/pause?robot=robot01", &headers, &json!({}));
        assert_eq!(answer.status, 403);
    }
    assert_ne!(status(&daemon)["state"], "paused");
    // There is no map yet, which the daemon says.
    assert_eq!(view.get(&format!("{path}&token={}", view.token())).status, 502);
    assert!(view.socket(&format!("?token={}", view.token())).is_ok());
    let headers = [("x-gmapd-token", view.token())];
    let answer = post(view.host(), "/command/pause?robot=robot01", &headers, &json!({}));
    assert_eq!(answer.status, 200, "{}", answer.text());
}

#[test]
fn a_socket_tells_who_is_there_and_what_the_robot_sees() {
    let daemon = Daemon::start("robot01");
    let view = View::on_loopback(&daemon);
    let robots = |is_alive| json!([{ "name": "robot01", "is_alive": is_alive }]);
    let mut mesh = view.socket("").expect("it is let in");
    mesh.wait("robots", |news| *news == robots(true));

    let mut page = view.socket("?robot=robot01").expect("it is let in");
    let directory = directory();
    let log = simulated_log(&directory);
    let mut play = program();
    play.args(["play", "-e", &daemon.endpoint, text(&log)]);
    play.args(["--prefix", "robot01", "--rate", "20"]);
    let _play = Background::start(&mut play);
    let numbers = |news: &Value| news.as_array().map_or(0, Vec::len);
    assert_eq!(page.wait("particles", |news| numbers(news) > 0).as_array().map(Vec::len), Some(60));
    page.wait("pose", |news| news["x"].as_f64().is_some_and(|x| x > 2.0));
    page.wait("path", |news| numbers(news) > 10);
    page.wait("status", |news| news["state"] == "mapping");
    // Odometry turns the scans between two that are matched; what is matched lies right.
    page.wait("scan", is_on_walls);

    daemon.background.interrupt();
    mesh.wait("robots", |news| *news == robots(false));
}

/// Whether most of a scan lies on the corridor's walls, 1.2 m to the left and right of x.
fn is_on_walls(scan: &Value) -> bool {
    let ys = scan.as_array().expect("numbers").iter().skip(1).step_by(2);
    let distances = ys.filter_map(Value::as_f64).map(|y| (y.abs() - 1.2).abs());
    let distances: Vec<f64> = distances.collect();
    let near = distances.iter().filter(|distance| **distance < 0.2).count();
    distances.len() > 60 && near * 10 > distances.len() * 8
}

/// Takes a page's tiles until they are the robot's whole map.
fn followed(view: &View) -> Mirror {
    let mut page = view.socket("?robot=robot01").expect("it is let in");
    let expected = view.get("/map/pgm?robot=robot01").body;
    let mut mirror = Mirror::new();
    while mirror.map().tiles() == 0 || map::pgm(&mirror.map().grid()) != expected {
        match page.message() {
            Message::Binary(bytes) => {
                mirror.take(&bytes).expect("they are tiles");
            }
            Message::Text(text) => assert!(!text.contains("clear"), "nothing was there before"),
            other => panic!("neither tiles nor text: {other:?}"),
        }
    }
    mirror
}

#[test]
fn tiles_of_a_socket_give_the_map() {
    let daemon = mapped();
    let view = View::on_loopback(&daemon);
    assert!(followed(&view).map().tiles() > 10);
}

#[test]
fn the_page_shows_a_robot_until_it_is_gone() {
    let daemon = Daemon::start("robot01");
    let view = View::on_loopback(&daemon);
    let mut page = Browser::start().open(&view.url);
    page.until("document.querySelector('nav a[aria-current]')?.textContent === 'robot01'");

    let directory = directory();
    let log = simulated_log(&directory);
    let mut play = program();
    play.args(["play", "-e", &daemon.endpoint, text(&log)]);
    play.args(["--prefix", "robot01", "--rate", "15"]);
    let mut play = Background::start(&mut play);
    page.until("document.querySelector('#state b').textContent === 'mapping'");
    let known = "parseInt(document.querySelector('#facts dd')?.textContent)";
    let first = page.until(&format!("{known} > 0 && {known}"));
    page.until(&format!("{known} > {first} + 20"));
    assert_eq!(play.exit_code(), Some(0));
    page.until(
        "[...document.querySelectorAll('#scans dd')].some(d => d.textContent === 'in the map')",
    );
    // The corridor of 60 m is drawn as a whole: the scale has grown with it.
    page.until("parseInt(document.querySelector('#scale').textContent) >= 5");
    page.until(
        "(({ data }) => data.filter((byte, i) => i % 4 === 3 && byte === 255).length > 10000)( \
         map.getContext('2d').getImageData(0, 0, map.width, map.height))",
    );
    page.screenshot("desktop");

    page.click("[data-tool=measure]");
    page.mouse(Mouse::Pressed, (700, 500));
    page.mouse(Mouse::Moved, (900, 500));
    page.until("/^1[0-9]\\.[0-9]{2} m$/.test(said.textContent)");
    page.mouse(Mouse::Released, (900, 500));
    page.click("[data-tool=measure]");
    page.mouse(Mouse::Wheel, (700, 400));
    page.until("document.querySelector('#scale').textContent === '50 cm'");
    page.click("#fit");
    page.until("parseInt(document.querySelector('#scale').textContent) === 5");

    // From below to above: the robot looks up there.
    page.click("[data-tool=initial_pose]");
    page.mouse(Mouse::Pressed, (700, 500));
    page.mouse(Mouse::Moved, (700, 400));
    page.mouse(Mouse::Released, (700, 300));
    page.until(
        "!said.hidden && said.className !== 'bad' && said.textContent.includes('the robot is at')",
    );
    let pose = &status(&daemon)["pose_in_map"];
    let theta = pose["theta"].as_f64().expect("a heading");
    assert!((theta - std::f64::consts::FRAC_PI_2).abs() < 0.01, "{pose}");

    page.click("[data-command=save]");
    page.until("!said.hidden && said.textContent.includes('map.pgm')");
    assert!(daemon.maps().join("map.pgm").exists());

    page.click("[data-command=pause]");
    page.until("document.querySelector('#state b').textContent === 'paused'");
    page.click("[data-command=resume]");
    page.until("document.querySelector('[data-command=pause]')");

    page.phone();
    page.screenshot("phone");
    daemon.background.interrupt();
    page.until("document.querySelector('#state b').textContent === 'gone'");
    page.until("document.querySelector('nav a.gone')?.textContent === 'robot01'");
    page.until("document.querySelector('[data-command=save]').disabled");
    page.screenshot("gone");
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[test]
fn what_cannot_be_downloaded_and_who_does_not_answer_is_said() {
    let daemon = Daemon::start("robot01");
    let view = View::on_loopback(&daemon);
    let mut page = Browser::start().open(&view.url);
    page.until("document.querySelector('#state b')?.textContent === 'waiting for scans'");
    page.click("[data-format=pgm]");
    page.until("said.className === 'bad' && said.textContent.startsWith('PGM: there is no map')");
    // It is alive until its link is missed.
    daemon.background.signal("-STOP");
    page.until("document.querySelector('#state b')?.textContent === 'does not answer'");
    daemon.background.signal("-CONT");
    page.until("document.querySelector('#state b')?.textContent === 'waiting for scans'");
}

/// Counts what is drawn from now on, by colour.
const COUNT_DRAWING: &str = "(() => {
    window.drawn = {};
    const canvas = CanvasRenderingContext2D.prototype;
    for (const [name, style] of
        [['fill', 'fillStyle'], ['fillRect', 'fillStyle'], ['stroke', 'strokeStyle']]) {
        const draw = canvas[name];
        canvas[name] = function (...values) {
            drawn[this[style]] = (drawn[this[style]] ?? 0) + 1;
            return draw.apply(this, values);
        };
    }
    return true;
})()";

#[test]
fn layers_appear_and_vanish_with_their_boxes() {
    let daemon = Daemon::start("robot01");
    let view = View::on_loopback(&daemon);
    let mut page = Browser::start().open(&view.url);
    page.until("document.querySelector('nav a[aria-current]')?.textContent === 'robot01'");
    page.until(COUNT_DRAWING);
    let directory = directory();
    let log = simulated_log(&directory);
    let mut play = program();
    play.args(["play", "-e", &daemon.endpoint, text(&log)]);
    play.args(["--prefix", "robot01", "--rate", "4"]);
    let _play = Background::start(&mut play);
    let colour = |layer: &str| {
        format!("getComputedStyle(document.documentElement).getPropertyValue('--{layer}').trim()")
    };
    let count = |layer: &str| format!("(drawn[{}] ?? 0)", colour(layer));
    // The robot itself has the colour of its path, and white around it.
    for layer in ["scan", "particles", "path", "accent"] {
        page.until(&format!("{} > 0", count(layer)));
    }
    page.screenshot("layers");
    let robots = "(drawn['#ffffff'] ?? 0)";
    for layer in ["scan", "particles", "path"] {
        let only_robots = if layer == "path" { robots } else { "0" };
        page.until(&format!(
            "(document.querySelector('[data-layer={layer}]').click(), drawn = {{}}, true)"
        ));
        page.until(&format!("{robots} > 2"));
        assert_eq!(page.until(&format!("({} === {only_robots}) + 1", count(layer))), 2, "{layer}");
        page.click(&format!("[data-layer={layer}]"));
        page.until(&format!("{} > {only_robots}", count(layer)));
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[test]
fn of_two_robots_the_chosen_one_is_shown_and_reset() {
    let daemon = mapped();
    let mut command = program();
    command.args(["run", "--prefix", "robot02", "-e", &daemon.endpoint, "--threads", "1"]);
    let second = Background::start(&mut command);
    let view = View::on_loopback(&daemon);
    let mut page = Browser::start().open(&format!("{}?robot=robot01", view.url));
    page.until("document.querySelectorAll('nav a').length === 2");
    let chosen =
        |name| format!("document.querySelector('[aria-current]')?.textContent === '{name}'");
    let facts = "document.querySelector('#facts dd')?.textContent";
    page.until(&format!("{} && /m² known/.test({facts})", chosen("robot01")));
    page.click("nav a:not([aria-current])");
    page.until(&format!("{} && {facts} === 'none yet'", chosen("robot02")));
    page.until("location.search === '?robot=robot02'");
    page.click("nav a:not([aria-current])");
    page.until(&format!("{} && /m² known/.test({facts})", chosen("robot01")));

    page.click("[data-command=reset]");
    page.until(&format!("{facts} === 'none yet'"));
    page.until("said.textContent.startsWith('map and path are forgotten')");
    assert_eq!(page.questions(), ["Forget the map of robot01?"]);
    second.interrupt();
    page.until("document.querySelector('nav a.gone')?.textContent === 'robot02'");
    page.screenshot("two-robots");
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[test]
fn a_page_whose_server_comes_back_has_one_socket() {
    let daemon = mapped();
    let view = View::on_loopback(&daemon);
    let mut page = Browser::start().open(&format!("{}?robot=robot01", view.url));
    page.until("/m² known/.test(document.querySelector('#facts dd')?.textContent)");
    // Another robot is chosen while the page waits to connect once more.
    page.until(
        "(() => {
            window.opened = 0;
            const Socket = WebSocket;
            window.WebSocket = class extends Socket {
                constructor(address) { super(address); opened += 1; window.newest = this; }
            };
            document.querySelector('nav a').click();
            return true;
        })()",
    );
    page.until("newest.readyState === WebSocket.OPEN");
    page.until(
        "new Promise((resolve) => {
            newest.addEventListener('close', () => {
                document.querySelector('nav a').click();
                // Longer than the page waits to connect once more.
                setTimeout(resolve, 1500, true);
            });
            newest.close();
        })",
    );
    assert_eq!(page.until("newest.readyState === WebSocket.OPEN && opened"), 2);
}
