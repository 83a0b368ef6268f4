//! Chromium without a screen, driven by the protocol of its developer tools.

use std::fs;
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};
use tempfile::TempDir;
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use crate::http;
use crate::processes::{Background, PATIENCE, directory, text};

/// What it may be called; `CHROMIUM` names another.
const NAMES: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "chrome"];

/// A running browser.
pub(crate) struct Browser {
    tools: WebSocket<MaybeTlsStream<TcpStream>>,
    calls: u64,
    /// What pages complained about.
    complaints: Vec<String>,
    /// What pages asked; they are answered with yes.
    questions: Vec<String>,
    _process: Background,
    _profile: TempDir,
}

impl Browser {
    pub(crate) fn start() -> Self {
        let profile = directory();
        let mut command = Command::new(program());
        command.args(["--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run"]);
        command.arg(format!("--user-data-dir={}", text(profile.path())));
        command.args(["--remote-debugging-port=0", "about:blank"]);
        let process = Background::start(&mut command);
        let line = process.line_with("DevTools listening on ");
        let address = line.rsplit_once(' ').expect("the line ends with an address").1;
        let (tools, _) = tungstenite::connect(address).expect("it listens there");
        if let MaybeTlsStream::Plain(stream) = tools.get_ref() {
            stream.set_read_timeout(Some(PATIENCE)).expect("any time will do");
        }
        Self {
            tools,
            calls: 0,
            complaints: Vec::new(),
            questions: Vec::new(),
            _process: process,
            _profile: profile,
        }
    }

    /// A page of the size of a screen.
    pub(crate) fn open(mut self, url: &str) -> Page {
        let blank = json!({ "url": "about:blank" });
        let target = self.call("", "Target.createTarget", &blank)["targetId"].take();
        let attach = json!({ "targetId": target, "flatten": true });
        let session = self.call("", "Target.attachToTarget", &attach)["sessionId"].take();
        let session = session.as_str().expect("sessions have names").to_owned();
        let mut page = Page { browser: self, session };
        for domain in ["Runtime", "Log", "Page"] {
            page.call(&format!("{domain}.enable"), &json!({}));
        }
        page.size((1280, 800), 1);
        page.call("Page.navigate", &json!({ "url": url }));
        page
    }

    fn call(&mut self, session: &str, method: &str, parameters: &Value) -> Value {
        let id = self.send(session, method, parameters);
        loop {
            let message = http::message(&mut self.tools);
            let message = message.unwrap_or_else(|error| panic!("{method} {parameters}: {error}"));
            let Ok(text) = message.into_text() else { continue };
            let mut answer: Value = serde_json::from_str(&text).unwrap_or_default();
            if answer["id"] == id {
                assert_eq!(answer["error"], Value::Null, "{method} {parameters}");
                return answer["result"].take();
            }
            match answer["method"].as_str().unwrap_or_default() {
                "Runtime.exceptionThrown" | "Log.entryAdded" => {
                    self.complaints.push(answer["params"].to_string());
                }
                // The script waits for an answer, and so does the call.
                "Page.javascriptDialogOpening" => {
                    let question = answer["params"]["message"].as_str().unwrap_or_default();
                    self.questions.push(question.to_owned());
                    self.send(session, "Page.handleJavaScriptDialog", &json!({ "accept": true }));
                }
                _ => {}
            }
        }
    }

    fn send(&mut self, session: &str, method: &str, parameters: &Value) -> u64 {
        self.calls += 1;
        let mut call = json!({ "id": self.calls, "method": method, "params": parameters });
        if !session.is_empty() {
            call["sessionId"] = session.into();
        }
        self.tools.send(Message::text(call.to_string())).expect("the browser listens");
        self.calls
    }
}

/// The browser of this machine.
fn program() -> String {
    if let Ok(name) = std::env::var("CHROMIUM") {
        return name;
    }
    let runs = |name: &&str| Command::new(name).arg("--version").output().is_ok();
    let found = NAMES.into_iter().find(runs);
    found.expect("Chromium is installed, or CHROMIUM names it").to_owned()
}

/// What a mouse does.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Mouse {
    Pressed,
    Moved,
    Released,
    /// Turned away from the user.
    Wheel,
}

/// A page, and the browser that it is alone in.
pub(crate) struct Page {
    browser: Browser,
    session: String,
}

impl Page {
    fn call(&mut self, method: &str, parameters: &Value) -> Value {
        self.browser.call(&self.session, method, parameters)
    }

    fn size(&mut self, (width, height): (u32, u32), scale: u32) {
        let size = json!({
            "width": width, "height": height, "deviceScaleFactor": scale, "mobile": scale > 1,
        });
        self.call("Emulation.setDeviceMetricsOverride", &size);
    }

    /// The page on a phone in the dark.
    pub(crate) fn phone(&mut self) {
        self.size((390, 844), 2);
        let dark = json!({ "name": "prefers-color-scheme", "value": "dark" });
        self.call("Emulation.setEmulatedMedia", &json!({ "features": [dark] }));
    }

    /// Waits until an expression is true, and returns what it is.
    pub(crate) fn until(&mut self, expression: &str) -> Value {
        let wait = format!(
            "new Promise((resolve) => {{
                const look = () => {{
                    const found = ({expression});
                    if (found) resolve(found); else requestAnimationFrame(look);
                }};
                look();
            }})"
        );
        let wait = json!({ "expression": wait, "awaitPromise": true, "returnByValue": true });
        let answer = self.call("Runtime.evaluate", &wait);
        assert_eq!(answer["exceptionDetails"], Value::Null, "{expression}");
        answer["result"]["value"].clone()
    }

    pub(crate) fn click(&mut self, selector: &str) {
        self.until(&format!("(document.querySelector('{selector}').click(), true)"));
    }

    pub(crate) fn mouse(&mut self, what: Mouse, (x, y): (u32, u32)) {
        let button = if matches!(what, Mouse::Wheel) { "none" } else { "left" };
        let event = json!({
            "type": format!("mouse{what:?}"), "x": x, "y": y, "button": button,
            "clickCount": 1, "deltaX": 0, "deltaY": -1000,
        });
        self.call("Input.dispatchMouseEvent", &event);
    }

    /// Keeps a picture of the page, to be looked at.
    pub(crate) fn screenshot(&mut self, name: &str) {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("view");
        fs::create_dir_all(&folder).expect("the target folder takes folders");
        let picture = self.call("Page.captureScreenshot", &json!({}));
        let picture = decoded(picture["data"].as_str().expect("a picture is text"));
        assert!(picture.starts_with(b"\x89PNG"), "{name}");
        fs::write(folder.join(format!("{name}.png")), picture).expect("it takes files");
    }

    /// What the page asked, each of it answered with yes.
    pub(crate) fn questions(&self) -> Vec<String> {
        self.browser.questions.clone()
    }

    /// Errors of scripts, and what the browser refused.
    pub(crate) fn complaints(&self) -> Vec<String> {
        self.browser.complaints.clone()
    }
}

/// The bytes of base64.
fn decoded(text: &str) -> Vec<u8> {
    let digits = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let digits = text.bytes().filter_map(|byte| digits.iter().position(|digit| *digit == byte));
    let digits: Vec<usize> = digits.collect();
    let group = |group: &[usize]| {
        let bits = group.iter().fold(0, |bits, digit| bits << 6 | digit) << (6 * (4 - group.len()));
        [16, 8, 0].map(|shift| (bits >> shift) as u8).into_iter().take(group.len() - 1)
    };
    digits.chunks(4).filter(|chunk| chunk.len() > 1).flat_map(group).collect()
}
