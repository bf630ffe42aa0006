//! A headless Chromium, driven over its DevTools protocol.

#![allow(dead_code, clippy::unwrap_used)]

use serde_json::{Value, json};
use std::cell::{Cell, RefCell};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tungstenite::{Message, WebSocket};

/// How long anything may take.
const PATIENCE: Duration = Duration::from_secs(120);

/// A browser with one page.
pub struct Browser {
    child: Child,
    socket: RefCell<WebSocket<TcpStream>>,
    next: Cell<u64>,
    /// What the page has complained of.
    complaints: RefCell<Vec<String>>,
    _profile: tempfile::TempDir,
}

/// The browser there is: `CZ_BROWSER`, or one of the usual names.
pub fn find() -> Option<PathBuf> {
    if let Some(named) = std::env::var_os("CZ_BROWSER") {
        return Some(named.into());
    }
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let paths = std::env::var_os("PATH")?;
    names
        .iter()
        .flat_map(|name| std::env::split_paths(&paths).map(move |path| path.join(name)))
        .find(|p| p.is_file())
}

impl Browser {
    /// Starts it with a window of that size; `None`, and says so, where there is none.
    pub fn start((width, height): (u32, u32)) -> Option<Browser> {
        let Some(program) = find() else {
            eprintln!("no Chromium is installed (or named by CZ_BROWSER): nothing is tested in a browser");
            return None;
        };
        let profile = tempfile::tempdir().unwrap();
        let mut child = Command::new(program)
            .args(["--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars"])
            .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
            .args(["--remote-debugging-port=0", "--force-color-profile=srgb"])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg(format!("--window-size={width},{height}"))
            .arg("about:blank")
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let listening = lines.find_map(|line| {
            let line = line.unwrap();
            Some(line.split_once("DevTools listening on ws://")?.1.split('/').next()?.to_owned())
        });
        let host = listening.expect("the browser says where it listens");
        // Or it would stop when nobody reads.
        std::thread::spawn(move || lines.for_each(drop));
        let target = page_of(&host);
        let stream = TcpStream::connect(&host).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let (socket, _) = tungstenite::client(target, stream).unwrap();
        let browser = Browser {
            child,
            socket: RefCell::new(socket),
            next: Cell::new(1),
            complaints: RefCell::default(),
            _profile: profile,
        };
        browser.resize((width, height));
        browser.call("Runtime.enable", json!({}));
        browser.call("Log.enable", json!({}));
        browser.call("Page.enable", json!({}));
        Some(browser)
    }

    /// Calls a method and returns its result.
    pub fn call(&self, method: &str, params: Value) -> Value {
        let id = self.next.replace(self.next.get() + 1);
        let request = json!({ "id": id, "method": method, "params": params });
        let mut socket = self.socket.borrow_mut();
        socket.send(Message::text(request.to_string())).unwrap();
        loop {
            let Message::Text(text) = socket.read().unwrap() else { continue };
            let answer: Value = serde_json::from_str(&text).unwrap();
            if answer["id"] == id {
                assert!(answer.get("error").is_none(), "{method}: {answer}");
                return answer["result"].clone();
            }
            self.note(&answer);
        }
    }

    fn note(&self, event: &Value) {
        let is_error =
            event["params"]["entry"]["level"] == "error" || event["method"] == "Runtime.exceptionThrown";
        let called = event["method"] == "Runtime.consoleAPICalled" && event["params"]["type"] == "error";
        if is_error || called {
            self.complaints.borrow_mut().push(event["params"].to_string());
        }
    }

    /// What the page has complained of so far.
    pub fn complaints(&self) -> Vec<String> {
        self.evaluate("0");
        self.complaints.borrow().clone()
    }

    pub fn open(&self, address: &str) {
        self.call("Page.navigate", json!({ "url": address }));
        self.until("document.readyState === 'complete'");
    }

    /// The value of an expression in the page; promises are waited for.
    pub fn evaluate(&self, expression: &str) -> Value {
        let params = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let result = self.call("Runtime.evaluate", params);
        assert!(result.get("exceptionDetails").is_none(), "{expression}: {result}");
        result["result"]["value"].clone()
    }

    /// Waits until an expression is true.
    pub fn until(&self, expression: &str) {
        let deadline = Instant::now() + PATIENCE;
        while self.evaluate(&format!("Boolean({expression})")) != json!(true) {
            assert!(Instant::now() < deadline, "never: {expression}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    pub fn click(&self, x: f64, y: f64) {
        for kind in ["mousePressed", "mouseReleased"] {
            let params = json!({ "type": kind, "x": x, "y": y, "button": "left", "clickCount": 1 });
            self.call("Input.dispatchMouseEvent", params);
        }
    }

    pub fn key(&self, key: &str) {
        for kind in ["keyDown", "keyUp"] {
            self.call("Input.dispatchKeyEvent", json!({ "type": kind, "key": key }));
        }
    }

    /// Makes the window so large.
    pub fn resize(&self, (width, height): (u32, u32)) {
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": false });
        self.call("Emulation.setDeviceMetricsOverride", metrics);
    }

    /// What is to be seen of the page, as PNG.
    pub fn picture(&self) -> Vec<u8> {
        let result = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        data_encoding::BASE64.decode(result["data"].as_str().unwrap().as_bytes()).unwrap()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Where the page of the browser is talked to.
fn page_of(host: &str) -> String {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let mut stream = TcpStream::connect(host).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        write!(stream, "GET /json/list HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").unwrap();
        let mut answer = String::new();
        // It may keep the connection open; what came until then is enough once it is whole.
        let mut buffer = [0; 65536];
        while let Ok(read) = stream.read(&mut buffer) {
            answer.push_str(&String::from_utf8_lossy(&buffer[..read]));
            if read == 0 || answer.trim_end().ends_with(']') {
                break;
            }
        }
        let body = answer.split_once("\r\n\r\n").map_or("[]", |(_, body)| body);
        let targets: Value = serde_json::from_str(body.trim()).unwrap_or_default();
        let page = targets.as_array().and_then(|all| all.iter().find(|target| target["type"] == "page"));
        if let Some(address) = page.and_then(|page| page["webSocketDebuggerUrl"].as_str()) {
            return address.to_owned();
        }
        assert!(Instant::now() < deadline, "the browser has no page: {answer}");
        std::thread::sleep(Duration::from_millis(50));
    }
}
