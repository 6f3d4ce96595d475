// SPDX-License-Identifier: MIT OR Apache-2.0
//! Plain Zenoh as its own examples measure it (`z_ping`, `z_pong`, `z_pub_thr`, `z_sub_thr`): two peers with one TCP link,
//! publishers that wait for the link, express, the answer sent from within the callback.

use std::time::Duration;

use tautline_exchange::{
    Arrivals, Exchange, Job, Line, Link, Result, Role, drive, on_network_thread, say, stop_flag,
    wait_for_stop,
};
use zenoh::bytes::ZBytes;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;
use zenoh::{Config, Session, Wait};

/// Runs one end to its end.
pub fn run(job: &Job) -> Result<()> {
    let own = job.clone();
    let session = on_network_thread(job, move || zenoh::open(config(&own)?).wait().map_err(text))?;
    let own = job.clone();
    job.as_application(move || match own.role {
        Role::Near => near(&session, &own),
        Role::Far => far(&session, &own),
    })
}

fn config(job: &Job) -> Result<Config> {
    let (listen, connect) = match &job.endpoint {
        Some(endpoint) => ("tcp/127.0.0.1:0", format!("[\"{endpoint}\"]")),
        None => ("tcp/127.0.0.1:0", "[]".to_owned()),
    };
    let config = format!(
        r#"{{ mode: "peer", listen: {{ endpoints: ["{listen}"] }}, connect: {{ endpoints: {connect} }},
             scouting: {{ multicast: {{ enabled: false }} }} }}"#
    );
    Config::from_json5(&config).map_err(text)
}

fn text(error: zenoh::Error) -> tautline_exchange::Error {
    error.to_string().into()
}

fn publisher(session: &Session, job: &Job) -> Result<Publisher<'static>> {
    let [to, _] = keys(job);
    // A stream fills its packets: as `z_pub_thr`.
    let express = job.exchange == Exchange::RoundTrips;
    let publisher =
        session.declare_publisher(to).congestion_control(CongestionControl::Block).express(express);
    publisher.wait().map_err(text)
}

/// Zenoh's keys do not begin with a slash.
fn keys(job: &Job) -> [String; 2] {
    job.topics().map(|topic| topic.trim_start_matches('/').to_owned())
}

struct Ends {
    publisher: Publisher<'static>,
    subscriber: Subscriber<FifoChannelHandler<Sample>>,
    /// All but the number: made once, as `z_ping` does.
    body: ZBytes,
}

fn near(session: &Session, job: &Job) -> Result<()> {
    let [_, from] = keys(job);
    let mut ends = Ends {
        publisher: publisher(session, job)?,
        subscriber: session.declare_subscriber(from).wait().map_err(text)?,
        body: vec![0; job.payload_bytes - size_of::<u64>()].into(),
    };
    if let Some(measured) = drive(job, &mut ends)? {
        say(&Line::Measured(measured));
    }
    Ok(())
}

impl Link for Ends {
    fn send(&mut self, number: u64) -> Result<()> {
        let mut payload = ZBytes::writer();
        payload.append(number.to_le_bytes().to_vec().into());
        payload.append(self.body.clone());
        self.publisher.put(payload.finish()).wait().map_err(text)
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        let sample = if patience.is_zero() {
            self.subscriber.try_recv()
        } else {
            self.subscriber.recv_timeout(patience)
        };
        Ok(sample.map_err(text)?.map(|sample| number(&sample)))
    }
}

fn far(session: &Session, job: &Job) -> Result<()> {
    let [_, from] = keys(job);
    let publisher = publisher(session, job)?;
    let is_stream = job.exchange != Exchange::RoundTrips;
    let mut arrivals = Arrivals::new(job);
    let answer = move |sample: Sample| {
        let payload = if is_stream {
            let Some(number) = arrivals.arrive(number(&sample)) else { return };
            ZBytes::from(number.to_le_bytes().to_vec())
        } else {
            sample.payload().clone()
        };
        // Ignored: the other end counts what it misses.
        let _ = publisher.put(payload).wait();
    };
    let _subscriber = session.declare_subscriber(from).callback_mut(answer).wait().map_err(text)?;
    let locators = session.info().locators().wait();
    let stop = stop_flag();
    say(&Line::Ready(locators.first().map(ToString::to_string)));
    wait_for_stop(&stop);
    Ok(())
}

fn number(sample: &Sample) -> u64 {
    let mut bytes = [0; size_of::<u64>()];
    let mut rest = &mut bytes[..];
    for slice in sample.payload().slices() {
        let len = slice.len().min(rest.len());
        let (head, tail) = rest.split_at_mut(len);
        head.copy_from_slice(&slice[..len]);
        rest = tail;
        if rest.is_empty() {
            break;
        }
    }
    u64::from_le_bytes(bytes)
}
