//! A small client of the WebDriver protocol (W3C), with chromium's own commands where it needs them.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};
use tempfile::TempDir;

/// The key under which the protocol names an element.
const ELEMENT: &str = "element-6066-11e4-a52e-4f735466cecf";

/// Longest wait for a condition.
const PATIENCE: Duration = Duration::from_secs(90);

/// A browser without a window, and its driver.
pub struct Browser {
    driver: Child,
    client: reqwest::Client,
    session: String,
    base: String,
    /// Where downloads go.
    pub downloads: TempDir,
    /// axe-core, if there is one.
    axe: Option<String>,
}

impl Drop for Browser {
    fn drop(&mut self) {
        // A driver that is killed leaves its browser behind: the session ends first.
        let (host, path) = self.session.trim_start_matches("http://").split_once('/').expect("a path");
        if let Ok(mut stream) = TcpStream::connect(host) {
            let asked = format!("DELETE /{path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n");
            let _ = stream.set_read_timeout(Some(Duration::from_secs(10)));
            let _ = stream.write_all(asked.as_bytes());
            let _ = stream.read(&mut [0; 1]);
        }
        let _ = self.driver.kill();
        let _ = self.driver.wait();
    }
}

fn program(names: &[&str]) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    let places: Vec<PathBuf> = std::env::split_paths(&path).collect();
    names.iter().flat_map(|name| places.iter().map(move |place| place.join(name))).find(|file| file.exists())
}

impl Browser {
    /// A browser for the service at `base`; `None`, with a message, where there is none on this machine.
    pub async fn start(base: &str) -> Option<Self> {
        let (Some(browser), Some(driver)) =
            (program(&["chromium", "google-chrome"]), program(&["chromedriver"]))
        else {
            println!("skipped: no chromium and chromium-driver on this machine");
            return None;
        };
        let mut driver = Command::new(driver)
            .arg("--port=0")
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("a driver");
        let out = BufReader::new(driver.stdout.take().expect("its output"));
        let port = out.lines().map_while(Result::ok).find_map(|line| {
            let rest = line.split("started successfully on port ").nth(1)?;
            rest.trim_end_matches('.').parse::<u16>().ok()
        });
        let downloads = TempDir::new().expect("a directory");
        let client = reqwest::Client::new();
        let root = format!("http://127.0.0.1:{}", port.expect("a port"));
        let wanted = json!({"capabilities": {"alwaysMatch": {
            "browserName": "chrome",
            "goog:loggingPrefs": {"browser": "ALL"},
            "goog:chromeOptions": {
                "binary": browser,
                "args": ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars",
                         "--window-size=1280,900"],
                "prefs": {"download.default_directory": downloads.path()},
            },
        }}});
        let made: Value = client
            .post(format!("{root}/session"))
            .json(&wanted)
            .send()
            .await
            .expect("the driver answers")
            .json()
            .await
            .expect("JSON");
        let id = made["value"]["sessionId"].as_str().unwrap_or_else(|| panic!("a session: {made}"));
        let session = format!("{root}/session/{id}");
        let limits = client.post(format!("{session}/timeouts")).json(&json!({"script": 10_000}));
        limits.send().await.expect("the driver answers");
        let axe = std::env::var("RIGCAST_AXE").ok().and_then(|file| std::fs::read_to_string(file).ok());
        Some(Self { driver, client, session, base: base.to_owned(), downloads, axe })
    }

    async fn ask(&self, path: &str, body: Value) -> Result<Value, String> {
        let sent = self.client.post(format!("{}{path}", self.session)).json(&body).send().await;
        let answer: Value = sent.expect("the driver answers").json().await.expect("JSON");
        match answer["value"]["error"].as_str() {
            Some(error) => Err(format!("{error}: {}", answer["value"]["message"])),
            None => Ok(answer["value"].clone()),
        }
    }

    async fn cdp(&self, command: &str, params: Value) -> Value {
        let body = json!({"cmd": command, "params": params});
        self.ask("/goog/cdp/execute", body).await.unwrap_or_else(|error| panic!("{command}: {error}"))
    }

    /// Goes to a path of the service.
    pub async fn go(&self, path: &str) {
        let url = format!("{}{path}", self.base);
        self.ask("/url", json!({"url": url})).await.unwrap_or_else(|error| panic!("{path}: {error}"));
    }

    /// The value of an expression in the page.
    pub async fn eval(&self, expression: &str) -> Value {
        let body = json!({"script": format!("return {expression};"), "args": []});
        self.ask("/execute/sync", body).await.unwrap_or_else(|error| panic!("{expression}: {error}"))
    }

    /// The path that the browser is at.
    pub async fn path(&self) -> String {
        self.eval("location.pathname").await.as_str().expect("a path").to_owned()
    }

    /// Waits until an expression is true in the page.
    #[track_caller]
    pub fn until(&self, expression: &str) -> impl Future<Output = ()> {
        let (caller, expression) = (std::panic::Location::caller(), expression.to_owned());
        async move {
            let begun = Instant::now();
            loop {
                let body = json!({"script": format!("return Boolean({expression});"), "args": []});
                if self.ask("/execute/sync", body).await == Ok(Value::Bool(true)) {
                    return;
                }
                if begun.elapsed() > PATIENCE {
                    let text = self.eval("document.body.innerText").await;
                    panic!("{caller}: never {expression} at {}: {text}", self.path().await);
                }
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    }

    async fn element(&self, css: &str) -> String {
        let found = self.ask("/element", json!({"using": "css selector", "value": css})).await;
        let found = found.unwrap_or_else(|error| panic!("{css}: {error}"));
        found[ELEMENT].as_str().expect("an element").to_owned()
    }

    /// Clicks an element.
    pub async fn click(&self, css: &str) {
        let element = self.element(css).await;
        let clicked = self.ask(&format!("/element/{element}/click"), json!({})).await;
        clicked.unwrap_or_else(|error| panic!("{css}: {error}"));
    }

    /// Types into a field that is emptied first; a file field gets the path of a file.
    pub async fn fill(&self, css: &str, text: &str) {
        let element = self.element(css).await;
        // A file field cannot be emptied, and needs not be.
        let _ = self.ask(&format!("/element/{element}/clear"), json!({})).await;
        let typed = self.ask(&format!("/element/{element}/value"), json!({"text": text})).await;
        typed.unwrap_or_else(|error| panic!("{css}: {error}"));
    }

    /// Chooses an option of a list by its value.
    pub async fn choose(&self, css: &str, value: &str) {
        self.eval(&format!(
            "(() => {{ const list = document.querySelector({css:?}); list.value = {value:?}; \
             list.dispatchEvent(new Event('change', {{bubbles: true}})); }})()"
        ))
        .await;
    }

    /// Whether the page shows a text.
    pub async fn shows(&self, text: &str) -> bool {
        self.eval(&format!("document.body.innerText.includes({text:?})")).await == Value::Bool(true)
    }

    async fn look(&self, width: u32, dark: bool) {
        let scheme = if dark { "dark" } else { "light" };
        self.cdp(
            "Emulation.setEmulatedMedia",
            json!({"features": [{"name": "prefers-color-scheme", "value": scheme}]}),
        )
        .await;
        let size = json!({"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": false});
        self.cdp("Emulation.setDeviceMetricsOverride", size).await;
    }

    /// Screenshots of the whole page: 1280 wide in light and dark, 1920 wide; and its check by axe-core.
    pub async fn shoot(&self, folder: &Path, name: &str) {
        self.until("!document.querySelector('[data-late]') || document.body.dataset.drawn").await;
        for (width, dark, ending) in [(1920, false, "-1920"), (1280, true, "-dark"), (1280, false, "")] {
            self.look(width, dark).await;
            let size = self.cdp("Page.getLayoutMetrics", json!({})).await["cssContentSize"].clone();
            let height = size["height"].as_f64().expect("a height").min(4000.0);
            let clip = json!({"x": 0, "y": 0, "width": width, "height": height, "scale": 1});
            let picture = self
                .cdp("Page.captureScreenshot", json!({"captureBeyondViewport": true, "clip": clip}))
                .await;
            let bytes = STANDARD.decode(picture["data"].as_str().expect("a picture")).expect("base64");
            std::fs::create_dir_all(folder).expect("a directory");
            std::fs::write(folder.join(format!("{name}{ending}.png")), bytes).expect("a file");
            if ending.is_empty() {
                self.shoot_top(folder, name).await;
            }
            if width == 1280 {
                self.check_by_axe(&format!("{name}{ending}")).await;
            }
        }
        let wide = self.eval("document.documentElement.scrollWidth > innerWidth + 1").await;
        assert_eq!(wide, Value::Bool(false), "{name} is wider than its window");
    }

    /// The upper part of the page, for the README.
    async fn shoot_top(&self, folder: &Path, name: &str) {
        let clip = json!({"x": 0, "y": 0, "width": 1280, "height": 800, "scale": 0.75});
        let picture =
            self.cdp("Page.captureScreenshot", json!({"captureBeyondViewport": true, "clip": clip})).await;
        let bytes = STANDARD.decode(picture["data"].as_str().expect("a picture")).expect("base64");
        std::fs::write(folder.join(format!("{name}-top.png")), bytes).expect("a file");
    }

    /// No serious violation of the rules of accessibility.
    async fn check_by_axe(&self, name: &str) {
        let Some(axe) = &self.axe else { return };
        let script = format!(
            "{axe};\nconst done = arguments[0];\naxe.run({{resultTypes: ['violations']}}).then(found => done(found.violations\
             .filter(v => ['serious', 'critical'].includes(v.impact)).map(v => v.id + ': ' + v.nodes.map(n => n.html).slice(0, 3).join(' '))));"
        );
        // The page of a job loads itself anew when the job ends, and takes the check with it.
        let mut found = Err(String::new());
        for _ in 0..3 {
            found = self.ask("/execute/async", json!({"script": script, "args": []})).await;
            if found.is_ok() {
                break;
            }
        }
        assert_eq!(found, Ok(json!([])), "{name}");
    }

    /// Lines of the browser's console that tell of a mistake: a refused script, a lost file.
    pub async fn complaints(&self) -> Vec<String> {
        let log = self.ask("/se/log", json!({"type": "browser"})).await.expect("a log");
        let lines = log.as_array().expect("lines").iter();
        lines.filter(|line| line["level"] == "SEVERE").map(|line| line["message"].to_string()).collect()
    }
}
