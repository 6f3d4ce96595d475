// SPDX-License-Identifier: MIT OR Apache-2.0
//! hiroz as its own example measures it (`z_pingpong`): a node each, `std_msgs/msg/ByteMultiArray`; two peers with one TCP
//! link.

use std::net::TcpListener;
use std::process::ExitCode;
use std::sync::{Mutex, mpsc};
use std::time::Duration;

use hiroz::context::{ZContext, ZContextBuilder};
use hiroz::msg::ZMessage;
use hiroz::node::ZNode;
use hiroz::pubsub::ZPub;
use hiroz::{Builder, ZBuf};
use hiroz_msgs::std_msgs::ByteMultiArray;
use tautline_exchange::{
    Arrivals, Exchange, Job, Line, Link, Result, Role, Stamp, drive, on_network_thread, program, say,
    stop_flag, wait_for_stop,
};
use zenoh_buffers::ZSlice;
use zenoh_buffers::buffer::SplitBuffer;

fn main() -> ExitCode {
    program("rival-hiroz", |job| run(&job))
}

fn run(job: &Job) -> Result<()> {
    let listen = match job.role {
        // hiroz does not say where it listens.
        Role::Far => format!("tcp/{}", TcpListener::bind("127.0.0.1:0")?.local_addr()?),
        Role::Near => "tcp/127.0.0.1:0".to_owned(),
    };
    let (own, at) = (job.clone(), listen.clone());
    let (context, node) = on_network_thread(job, move || {
        let context = context(&own, &at)?;
        let name = if own.role == Role::Near { "near" } else { "far" };
        let node = context.create_node(name).without_parameters().build()?;
        Ok((context, node))
    })?;
    let own = job.clone();
    job.as_application(move || {
        let _context = context;
        match own.role {
            Role::Near => near(&node, &own),
            Role::Far => far(&node, &own, listen),
        }
    })
}

fn context(job: &Job, listen: &str) -> Result<ZContext> {
    let builder = ZContextBuilder::default()
        .with_mode("peer")
        .with_domain_id(job.domain as usize)
        .with_listen_endpoints([listen])
        .with_connect_endpoints(job.endpoint.clone())
        .disable_multicast_scouting();
    builder.build()
}

struct Ends {
    publisher: ZPub<ByteMultiArray, <ByteMultiArray as ZMessage>::Serdes>,
    received: mpsc::Receiver<u64>,
    /// All but the number: made once, unless it is written for each message.
    body: Option<ZSlice>,
    bytes: usize,
}

fn near(node: &ZNode, job: &Job) -> Result<()> {
    let [to, from] = job.topics();
    let (sender, received) = mpsc::channel();
    let subscription = node.create_sub::<ByteMultiArray>(&from);
    let whole = job.way.whole;
    let _subscription = subscription.build_with_callback(move |message: ByteMultiArray| {
        let _ = sender.send(if whole { read(&message) } else { number(&message) });
    })?;
    let (publisher, bytes) = (node.create_pub::<ByteMultiArray>(&to).build()?, job.payload_bytes);
    let body = (!whole).then(|| ZSlice::from(vec![0; bytes - size_of::<u64>()]));
    let mut ends = Ends { publisher, received, body, bytes };
    drive(job, &mut ends)
}

impl Link for Ends {
    fn send(&mut self, number: u64) -> Result<()> {
        self.publisher.publish(&match &self.body {
            Some(body) => message(number, Some(body)),
            None => written(number, self.bytes),
        })
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        match self.received.recv_timeout(patience) {
            Ok(number) => Ok(Some(number)),
            Err(mpsc::RecvTimeoutError::Timeout) => Ok(None),
            Err(mpsc::RecvTimeoutError::Disconnected) => Err("the subscription ended".into()),
        }
    }
}

fn far(node: &ZNode, job: &Job, endpoint: String) -> Result<()> {
    let [to, from] = job.topics();
    let publisher = node.create_pub::<ByteMultiArray>(&to).build()?;
    let (is_stream, whole, bytes) = (job.exchange != Exchange::RoundTrips, job.way.whole, job.payload_bytes);
    let arrivals = Mutex::new(Arrivals::new(job));
    let answer = move |question: ByteMultiArray| {
        let answer = if is_stream {
            let Ok(mut arrivals) = arrivals.lock() else { return };
            let Some(number) = arrivals.arrive(number(&question)) else { return };
            message(number, None)
        } else if whole {
            written(read(&question), bytes)
        } else {
            question
        };
        // Ignored: the other end counts what it misses.
        let _ = publisher.publish(&answer);
    };
    let _subscription = node.create_sub::<ByteMultiArray>(&from).build_with_callback(answer)?;
    let stop = stop_flag();
    say(&Line::Ready(Some(endpoint)));
    wait_for_stop(&stop);
    Ok(())
}

fn message(number: u64, body: Option<&ZSlice>) -> ByteMultiArray {
    let mut data = zenoh_buffers::ZBuf::default();
    data.push_zslice(ZSlice::from(number.to_le_bytes().to_vec()));
    body.cloned().into_iter().for_each(|body| data.push_zslice(body));
    ByteMultiArray { data: ZBuf(data), ..Default::default() }
}

/// A message that is written whole.
fn written(number: u64, bytes: usize) -> ByteMultiArray {
    let data = Stamp { number, sent_ns: 0 }.written(bytes);
    ByteMultiArray { data: ZBuf(zenoh_buffers::ZBuf::from(data)), ..Default::default() }
}

/// Goes through all of a message; one that is damaged ends the process.
fn read(message: &ByteMultiArray) -> u64 {
    match Stamp::read(&message.data.0.contiguous(), true) {
        Ok(stamp) => stamp.number,
        Err(error) => {
            eprintln!("rival-hiroz: {error}");
            std::process::exit(1);
        }
    }
}

fn number(message: &ByteMultiArray) -> u64 {
    // One slice, or the first of them: no copy of what follows.
    let first = message.data.0.slices().next().and_then(|slice| slice.first_chunk().copied());
    u64::from_le_bytes(first.unwrap_or_default())
}
