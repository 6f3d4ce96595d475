// SPDX-License-Identifier: MIT OR Apache-2.0
//! The client and the server of the services bench on r2r, spun as r2r's manual shows, over whatever ROS 2 it was built with.
//!
//! Started by Tautline's `bench services` with `--child` and a job as JSON. Request and response are `test_msgs/srv/BasicTypes`:
//! numbers, one of which counts, and a text that makes the request as long as the job says and the response 64 bytes.

#[path = "../version.rs"]
mod version;

use std::cell::RefCell;
use std::error::Error;
use std::io::{Write, stdout};
use std::process::ExitCode;
use std::rc::Rc;
use std::time::Duration;

use futures::StreamExt;
use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use r2r::test_msgs::srv::BasicTypes;
use r2r::{Client, Context, Node, QosProfile};
use rustix::process::{Signal, set_parent_process_death_signal};
use serde_json::Value;
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{CoreSet, Policy, set_affinity, set_policy};

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// As the other systems' threads that measure.
const PRIORITY: u8 = 50;
/// How long an answer is waited for.
const PATIENCE_NS: u64 = 2_000_000_000;
/// What of a message is no text, in CDR.
const NUMBERS_BYTES: usize = 61;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("services-r2r: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["--version"] => println!("{}", version::version()?),
        ["--child", job] => {
            set_parent_process_death_signal(Some(Signal::KILL))?;
            let job: Value = serde_json::from_str(job)?;
            if job["asks"] == true { ask(&job)? } else { answer(&job)? }
        }
        _ => return Err("to be started by `cargo xtask bench services`".into()),
    }
    Ok(())
}

fn node(job: &Value) -> Result<Node> {
    let core = job["core"].as_u64().and_then(|core| usize::try_from(core).ok()).ok_or("a core")?;
    // The middleware's threads inherit it.
    set_affinity(CoreSet::one(core))?;
    let namespace = format!("/pair{}", job["pair"].as_str().ok_or("a pair")?);
    Ok(Node::create(Context::create()?, "services", &namespace)?)
}

/// Of the thread that spins, and of no thread of the middleware's.
fn go_realtime(job: &Value) -> Result<()> {
    if job["realtime"] == true {
        set_policy(Policy::Fifo(PRIORITY))?;
    }
    Ok(())
}

fn text(message_bytes: usize) -> String {
    "x".repeat(message_bytes.saturating_sub(NUMBERS_BYTES))
}

fn answer(job: &Value) -> Result<()> {
    let mut node = node(job)?;
    let mut requests = node.create_service::<BasicTypes::Service>("ask", QosProfile::default())?;
    let mut pool = LocalPool::new();
    pool.spawner().spawn_local(async move {
        while let Some(request) = requests.next().await {
            let uint64_value = request.message.uint64_value;
            let response =
                BasicTypes::Response { uint64_value, string_value: text(64), ..Default::default() };
            request.respond(response).expect("the client waits");
        }
    })?;
    go_realtime(job)?;
    println!("\"ready\"");
    stdout().flush()?;
    loop {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
    }
}

#[derive(Default)]
struct Clock {
    times_ns: Vec<u64>,
    asked: u64,
    answered: u64,
    started_ns: u64,
    is_over: bool,
}

fn ask(job: &Value) -> Result<()> {
    let part = |part: &str| job["budget"][part].as_u64().ok_or("a budget");
    let budget_ns = part("secs")? * 1_000_000_000 + part("nanos")?;
    let bytes = job["bytes"].as_u64().and_then(|bytes| usize::try_from(bytes).ok()).ok_or("a length")?;
    let mut node = node(job)?;
    let client = node.create_client::<BasicTypes::Service>("ask", QosProfile::default())?;
    let available = Node::is_available(&client)?;
    let clock = Rc::new(RefCell::new(Clock::default()));
    let mut pool = LocalPool::new();
    go_realtime(job)?;
    let run = {
        let clock = clock.clone();
        async move {
            available.await.expect("the service");
            measure(&client, bytes, budget_ns, &clock).await;
            clock.borrow_mut().is_over = true;
        }
    };
    pool.spawner().spawn_local(run)?;
    loop {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
        let clock = clock.borrow();
        let is_lost = clock.started_ns != 0 && monotonic_ns() - clock.started_ns > PATIENCE_NS;
        if clock.is_over || is_lost {
            break;
        }
    }
    let clock = clock.borrow();
    let counts: Vec<(u64, u64)> = clock.times_ns.iter().map(|&time_ns| (time_ns, 1)).collect();
    println!(
        "{}",
        serde_json::json!({ "measured": { "counts": counts, "lost": clock.asked - clock.answered } })
    );
    Ok(stdout().flush()?)
}

/// For as long as the budget says, after a warm-up of an eighth of that.
async fn measure(client: &Client<BasicTypes::Service>, bytes: usize, budget_ns: u64, clock: &RefCell<Clock>) {
    let mut request = BasicTypes::Request { string_value: text(bytes), ..Default::default() };
    let begun_ns = monotonic_ns();
    loop {
        let started_ns = monotonic_ns();
        {
            let mut clock = clock.borrow_mut();
            if started_ns - begun_ns > budget_ns + budget_ns / 8 && !clock.times_ns.is_empty() {
                return;
            }
            clock.asked += 1;
            clock.started_ns = started_ns;
            request.uint64_value = clock.asked;
        }
        let response = client.request(&request).expect("it is sent").await.expect("an answer");
        let now_ns = monotonic_ns();
        let mut clock = clock.borrow_mut();
        assert_eq!(response.uint64_value, clock.asked, "the answer to another question");
        clock.answered += 1;
        if now_ns - begun_ns > budget_ns / 8 {
            clock.times_ns.push(now_ns - started_ns);
        }
    }
}
