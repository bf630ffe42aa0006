//! The page and its data, served on this machine to whoever knows the address.
//!
//! Another user of the machine can connect, and so can any page open in the browser. So the address holds a
//! random token, `Host` must be ours (a name that somebody lets point here is not), and where a request has an
//! `Origin` it must be the page's own.

use crate::run::Run;
use crate::wire;
use axum::body::Body;
use axum::extract::{Path, Query, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use control_zones::process::Steering;
use serde::Deserialize;
use serde_json::{Value, json};
use std::io;
use std::net::{Ipv4Addr, TcpListener};
use std::sync::Arc;

const PAGE: &str = include_str!("../assets/index.html");
const SCRIPT: &str = include_str!("../assets/view.js");
const STYLE: &str = include_str!("../assets/view.css");

/// Nothing but what is served here, and nobody else's frame around it.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Steps handed out at once at most, in bytes.
const MOST_BYTES: usize = 8 << 20;

/// A server that has its port and does not answer yet.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    token: String,
    runs: Vec<Arc<Run>>,
}

struct Served {
    runs: Vec<Arc<Run>>,
    token: String,
    hosts: [String; 2],
}

impl Server {
    /// A server of these runs on 127.0.0.1; port 0 is any that is free.
    pub fn new(runs: Vec<Arc<Run>>, port: u16) -> io::Result<Server> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port))?;
        Ok(Server { listener, token: new_token()?, runs })
    }

    /// Where the page is.
    pub fn address(&self) -> io::Result<String> {
        Ok(format!("http://{}/{}/", self.listener.local_addr()?, self.token))
    }

    /// Serves until the process ends.
    pub fn serve(self) -> io::Result<()> {
        let port = self.listener.local_addr()?.port();
        let served = Arc::new(Served {
            runs: self.runs,
            token: self.token,
            hosts: [format!("127.0.0.1:{port}"), format!("localhost:{port}")],
        });
        let router = Router::new()
            .route("/{token}/", get(|| async { asset("text/html; charset=utf-8", PAGE) }))
            .route("/{token}/view.js", get(|| async { asset("text/javascript; charset=utf-8", SCRIPT) }))
            .route("/{token}/view.css", get(|| async { asset("text/css; charset=utf-8", STYLE) }))
            .route("/{token}/api/{what}", get(ask))
            .route("/{token}/api/steer", post(steer))
            .layer(middleware::from_fn_with_state(served.clone(), guard))
            .with_state(served);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        runtime.block_on(async {
            self.listener.set_nonblocking(true)?;
            axum::serve(tokio::net::TcpListener::from_std(self.listener)?, router).await
        })
    }
}

/// 128 bits nobody can guess.
fn new_token() -> io::Result<String> {
    let mut token = [0_u8; 16];
    rustix::rand::getrandom(&mut token, rustix::rand::GetRandomFlags::empty())?;
    Ok(token.iter().map(|byte| format!("{byte:02x}")).collect())
}

fn asset(kind: &'static str, text: &'static str) -> Response {
    ([(header::CONTENT_TYPE, kind)], text).into_response()
}

/// Compares in a time that does not tell how much is right.
fn is_equal(a: &str, b: &str) -> bool {
    a.len() == b.len() && a.bytes().zip(b.bytes()).fold(0, |differ, (a, b)| differ | (a ^ b)) == 0
}

/// Why a request is refused, if it is.
fn refusal(served: &Served, path: &str, headers: &HeaderMap) -> Option<&'static str> {
    let text = |name| headers.get(name).map(|value: &HeaderValue| value.to_str().unwrap_or("?"));
    if !text(header::HOST).is_some_and(|host| served.hosts.iter().any(|own| own == host)) {
        return Some("another host name than this page's");
    }
    let is_own =
        |origin: &str| served.hosts.iter().any(|own| origin.strip_prefix("http://") == Some(own.as_str()));
    if text(header::ORIGIN).is_some_and(|origin| !is_own(origin)) {
        return Some("a page of another origin");
    }
    let site = headers.get("sec-fetch-site").map(|site| site.to_str().unwrap_or("?"));
    if site.is_some_and(|site| site != "same-origin" && site != "none") {
        return Some("a page of another origin");
    }
    let token = path.split('/').nth(1).unwrap_or_default();
    (!is_equal(token, &served.token)).then_some("the address lacks the right token")
}

async fn guard(State(served): State<Arc<Served>>, request: Request, next: Next) -> Response {
    let mut response = match refusal(&served, request.uri().path(), request.headers()) {
        None => next.run(request).await,
        Some(reason) => (StatusCode::FORBIDDEN, format!("refused: {reason}\n")).into_response(),
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-store"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.insert("cross-origin-resource-policy", HeaderValue::from_static("same-origin"));
    response
}

/// What a question may say more precisely.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Question {
    /// Which run.
    run: usize,
    step: u64,
    from: u64,
    to: u64,
    count: u64,
    vehicle: u32,
    zone: u32,
    bins: usize,
}

async fn ask(
    State(served): State<Arc<Served>>,
    Path((_, what)): Path<(String, String)>,
    Query(question): Query<Question>,
) -> Response {
    // Reads files and may take a while.
    let answer = tokio::task::spawn_blocking(move || answer(&served, &what, &question)).await;
    answer.unwrap_or_else(|_| (StatusCode::INTERNAL_SERVER_ERROR, "internal error\n").into_response())
}

fn answer(served: &Served, what: &str, q: &Question) -> Response {
    let not_there = |reason: String| (StatusCode::NOT_FOUND, reason + "\n").into_response();
    let said = |result: Result<Value, String>| match result {
        Ok(value) => Json(value).into_response(),
        Err(reason) => not_there(reason),
    };
    match what {
        "begin" => {
            // What waits for somebody to look goes on from now on.
            served.runs.iter().filter_map(|run| run.live.as_ref()).for_each(|live| live.begin());
            return Json(json!({})).into_response();
        }
        "runs" => {
            return Json(served.runs.iter().map(|run| run.describe()).collect::<Value>()).into_response();
        }
        "status" => {
            let mut all: Vec<Value> = served.runs.iter().map(|run| run.status()).collect();
            if let [first, second] = &served.runs[..] {
                all[1]["differs_at"] = json!(second.index().differs_from(&first.index()));
            }
            return Json(all).into_response();
        }
        _ => {}
    }
    let Some(run) = served.runs.get(q.run) else { return not_there(format!("there is no run {}", q.run)) };
    match what {
        "frames" => binary(frames(run, q.from, q.count)),
        "traces" => binary(run.traces(q.zone, (q.from, q.to))),
        "vehicle" => said(run.vehicle(q.step, q.vehicle)),
        "course" => said(run.course(q.vehicle)),
        "zone" => said(run.zone(q.step, q.zone)),
        "zones" => said(run.zones(q.step, q.count)),
        "lines" => said(Ok(run.lines(q.bins))),
        "events" => said(Ok(run.events())),
        _ => not_there(format!("there is nothing called {what}")),
    }
}

fn binary(bytes: Vec<u8>) -> Response {
    ([(header::CONTENT_TYPE, "application/octet-stream")], Body::from(bytes)).into_response()
}

/// Steps from one on, those that are there.
fn frames(run: &Run, from: u64, count: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    for number in from..from.saturating_add(count.min(1000)) {
        if let Ok(Some(step)) = run.steps.step(number) {
            wire::encode(&step, &mut bytes);
        }
        if bytes.len() >= MOST_BYTES {
            break;
        }
    }
    bytes
}

async fn steer(
    State(served): State<Arc<Served>>,
    Query(q): Query<Question>,
    Json(steering): Json<Steering>,
) -> Response {
    let live = served.runs.get(q.run).and_then(|run| run.live.as_ref());
    match live.map(|live| live.steer(&steering)) {
        Some(Ok(())) => Json(json!({ "is_done": true })).into_response(),
        Some(Err(reason)) => (StatusCode::CONFLICT, reason + "\n").into_response(),
        None => (StatusCode::CONFLICT, "a recording cannot be steered\n").into_response(),
    }
}
