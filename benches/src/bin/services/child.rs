// SPDX-License-Identifier: MIT OR Apache-2.0
//! One process of a pair; Tautline's ways as its users have them: a callback thread, the main thread as the sampler.

use std::sync::mpsc;

use futures::StreamExt;
use rustix::process::{Signal, set_parent_process_death_signal};
use tautline::{
    CallbackOptions, Client, Context, Limits, Message, Node, PendingResponse, Plain, Publisher, Qos,
    Realtime, Request, Server, Service, ServiceRequest, Subscription,
};
use tautline_benches::Distribution;
use tautline_benches::pair::{Line, Measured};
use tautline_rt::clock::monotonic_ns;

use crate::{Job, PRIORITY, Result, System, iceoryx};

/// Measures round trips for as long as the job says, after a warm-up of an eighth of that.
pub struct Clock {
    distribution: Distribution,
    number: u64,
    answered: u64,
    begun_ns: u64,
    started_ns: u64,
    budget_ns: u64,
}

impl Clock {
    /// More than any system has buffers.
    const WARM_UP: u64 = 200;

    pub fn new(job: &Job) -> Self {
        let budget_ns = job.budget.as_nanos() as u64;
        Clock {
            distribution: Distribution::new(),
            number: 0,
            answered: 0,
            begun_ns: monotonic_ns(),
            started_ns: 0,
            budget_ns,
        }
    }

    /// The number of the next question, while there is one.
    pub fn start(&mut self) -> Option<u64> {
        self.started_ns = monotonic_ns();
        let over = self.started_ns - self.begun_ns > self.budget_ns + self.budget_ns / 8;
        (!over || self.distribution.is_empty()).then(|| {
            self.number += 1;
            self.number
        })
    }

    /// Its answer is there.
    pub fn end(&mut self, answer: u64) {
        let now_ns = monotonic_ns();
        assert_eq!(answer, self.number, "the answer to another question");
        self.answered += 1;
        if self.number > Self::WARM_UP && now_ns - self.begun_ns > self.budget_ns / 8 {
            self.distribution.record(now_ns - self.started_ns);
        }
    }

    /// Says what was measured.
    pub fn print(&self) -> Result<()> {
        let (counts, lost) = (self.distribution.counts(), self.number - self.answered);
        Line::Measured(Measured { counts, lost }).say()
    }
}

/// A message of one of the measured sizes, of which the first word is used.
trait Frame: Message + Plain {
    fn word(&mut self) -> &mut u64;
    fn number(&self) -> u64;
}

/// A service whose request is a frame; the response has 64 bytes.
macro_rules! frame {
    ($name:ident, $service:ident, $text:literal, $bytes:expr) => {
        #[derive(Message, Clone, Copy)]
        #[repr(C)]
        #[message(name = $text)]
        struct $name {
            words: [u64; $bytes / 8],
        }

        impl Frame for $name {
            fn word(&mut self) -> &mut u64 {
                &mut self.words[0]
            }

            fn number(&self) -> u64 {
                self.words[0]
            }
        }

        struct $service;

        impl Service for $service {
            type Request = $name;
            type Response = Frame64B;
            type Event = Frame64B;
            const TYPE_NAME: &'static str = concat!($text, "Service");
            const TYPE_HASH: &'static str =
                "RIHS01_0000000000000000000000000000000000000000000000000000000000000000";
        }
    };
}

frame!(Frame64B, Service64B, "bench_msgs/msg/Frame64B", 64);
frame!(Frame4KiB, Service4KiB, "bench_msgs/msg/Frame4KiB", 4 << 10);
frame!(Frame1MiB, Service1MiB, "bench_msgs/msg/Frame1MiB", 1 << 20);

pub fn run(job: &str) -> Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let job: Job = serde_json::from_str(job)?;
    if job.system == System::Iceoryx2 {
        return iceoryx::run(&job);
    }
    match job.bytes {
        64 => play::<Service64B>(&job),
        4_096 => play::<Service4KiB>(&job),
        1_048_576 => play::<Service1MiB>(&job),
        bytes => Err(format!("there is no frame of {bytes} bytes").into()),
    }
}

fn play<S: Service<Response = Frame64B>>(job: &Job) -> Result<()>
where
    S::Request: Frame,
{
    let context = Context::builder()
        .realtime(if job.realtime { Realtime::Required } else { Realtime::Off })
        .sampler_priority(PRIORITY + 10)
        .sampler_core(job.core)
        .build()?;
    let mut node = Node::create(context.clone(), "services", &format!("/pair{}", job.pair))?;
    let options = CallbackOptions::fifo(PRIORITY).core(job.core).name("bench");
    let qos = Qos::keep_last(2);
    if job.system == System::Topics {
        let (to, from) = if job.asks { ("ping", "pong") } else { ("pong", "ping") };
        if job.asks {
            let publisher = node.create_publisher::<S::Request>(to, qos)?;
            let answers = node.subscribe::<Frame64B>(from, qos)?;
            return until_done(&node, options, ask_topic(Clock::new(job), publisher, answers));
        }
        let publisher = node.create_publisher::<Frame64B>(to, qos)?;
        let questions = node.subscribe::<S::Request>(from, qos)?;
        let answer = questions.for_each(move |question| {
            publish(&publisher, question.number());
            futures::future::ready(())
        });
        return serve(&node, options, answer);
    }
    node.set_service_limits("ask", Limits { loans: 2, ..Limits::default() })?;
    if !job.asks {
        if job.system == System::ServiceOwned {
            let requests = node.create_service::<S>("ask", qos)?.owned();
            let answer = |mut request: ServiceRequest<S>| {
                let mut words = [0; 8];
                words[0] = *request.message.word();
                request.respond(Frame64B { words }).expect("the client waits");
                futures::future::ready(())
            };
            return serve(&node, options, requests.for_each(answer));
        }
        let mut service = node.create_service::<S>("ask", qos)?;
        return serve(&node, options, async move {
            while let Some(request) = service.next().await {
                respond(&service, &request);
            }
        });
    }
    let mut clock = Clock::new(job);
    if job.system == System::ServiceOwned {
        let client = node.create_client::<Service64B>("ask")?;
        return until_done(&node, options, async move {
            while let Some(number) = clock.start() {
                let mut words = [0; 8];
                words[0] = number;
                let response = client.request(&Frame64B { words }).expect("it is sent").await;
                clock.end(response.expect("an answer").words[0]);
            }
            clock
        });
    }
    let client = node.create_client::<S>("ask")?;
    until_done(&node, options, async move {
        while let Some(number) = clock.start() {
            let response = ask(&client, number).await;
            clock.end(response.expect("an answer").number());
        }
        clock
    })
}

async fn ask_topic<T: Frame>(
    mut clock: Clock,
    publisher: Publisher<T>,
    mut answers: Subscription<Frame64B>,
) -> Clock {
    while let Some(number) = clock.start() {
        publish(&publisher, number);
        let answer = answers.next().await.expect("it never ends");
        clock.end(answer.number());
    }
    clock
}

// A loan stays in its thread, so that no future that may leave it can hold one while it waits.

fn publish<T: Frame>(publisher: &Publisher<T>, number: u64) {
    let mut message = publisher.loan().expect("a loan is free");
    *message.word() = number;
    message.publish().expect("keep-last");
}

fn ask<S: Service<Request: Frame>>(client: &Client<S>, number: u64) -> PendingResponse<S> {
    let mut request = client.loan().expect("a loan is free");
    *request.word() = number;
    client.send(request).expect("it is sent")
}

fn respond<S: Service<Request: Frame, Response: Frame>>(service: &Server<S>, request: &Request<S>) {
    let mut response = service.loan(request).expect("a loan is free");
    *response.word() = request.number();
    response.send().expect("the client waits");
}

fn serve(
    node: &Node,
    options: CallbackOptions,
    answer: impl Future<Output = ()> + Send + 'static,
) -> Result<()> {
    let _callback = node.spawn_callback(options, answer)?;
    Line::Ready.say()?;
    Ok(node.spin()?)
}

fn until_done(
    node: &Node,
    options: CallbackOptions,
    ask: impl Future<Output = Clock> + Send + 'static,
) -> Result<()> {
    let (sender, result) = mpsc::channel();
    let events = node.context().events().clone();
    let callback = node.spawn_callback(options, async move {
        let _ = sender.send(ask.await);
        events.stop();
    })?;
    node.spin()?;
    callback.join()?;
    result.recv()?.print()
}
