// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tautline's requests: a service in place or with owned messages, beside a topic each way. A response has 64 bytes.

use std::pin::pin;

use ::tautline::{Client, Limits, PendingResponse, Request, Server, Service, ServiceRequest, Timer};
use futures::StreamExt;
use futures::future::{Either, select};
use tautline_exchange::{Job, Measured, Result, Role, RoundTrips, Stamp};
use tautline_rt::clock::monotonic_ns;

use super::tautline::{End, Frame, Frame1MiB, Frame4KiB, Frame64B, play};

macro_rules! services {
    ($($bytes:literal $name:ident $request:ident $ros_name:literal,)*) => {
        $(
            struct $name;

            impl Service for $name {
                type Request = $request;
                type Response = Frame64B;
                type Event = Frame64B;
                const TYPE_NAME: &'static str = $ros_name;
                const TYPE_HASH: &'static str =
                    "RIHS01_0000000000000000000000000000000000000000000000000000000000000000";
            }
        )*

        /// Runs one end to its end.
        pub fn run(job: &Job) -> Result<()> {
            match job.payload_bytes {
                $($bytes => of::<$name>(job),)*
                bytes => Err(format!("there is no service of {bytes} bytes").into()),
            }
        }
    };
}

services! {
    64 Service64B Frame64B "bench_msgs/srv/Service64B",
    4096 Service4KiB Frame4KiB "bench_msgs/srv/Service4KiB",
    1048576 Service1MiB Frame1MiB "bench_msgs/srv/Service1MiB",
}

fn of<S: Service<Request: Frame, Response = Frame64B>>(job: &Job) -> Result<()> {
    if job.way.mode == "topics" {
        return play::<S::Request, Frame64B>(job);
    }
    let mut end = End::<S::Request, Frame64B>::new(job)?;
    end.node.set_service_limits(&job.topic, Limits { loans: 2, ..Limits::default() })?;
    let is_owned = job.way.mode == "service-owned";
    if job.role == Role::Far {
        let mut service = end.node.create_service::<S>(&job.topic, end.qos())?;
        if is_owned {
            let mut requests = service.owned();
            return end.serve(async move {
                while let Some(request) = requests.next().await {
                    respond_owned(request)?;
                }
                Ok(())
            });
        }
        return end.serve(async move {
            while let Some(request) = service.next().await {
                respond(&service, &request)?;
            }
            Ok(())
        });
    }
    let client = end.node.create_client::<S>(&job.topic)?;
    let (trips, patience) = (RoundTrips::new(job), end.patience()?);
    if is_owned {
        let client = end.node.create_client::<Service64B>(&job.topic)?;
        return end.measure(ask(trips, patience, move |number| {
            let mut message = Frame64B { bytes: [0; 64] };
            stamp(number).write(&mut message.bytes, false);
            let response = client.request(&message)?;
            Ok(async move { number_of(&response.await?) })
        }));
    }
    end.measure(ask(trips, patience, move |number| {
        let response = request(&client, number)?;
        Ok(async move { number_of(&*response.await?) })
    }))
}

/// Asks until enough was measured.
async fn ask<F: Future<Output = Result<u64>>>(
    mut trips: RoundTrips,
    mut patience: Timer,
    send: impl Fn(u64) -> Result<F>,
) -> Result<Measured> {
    while let Some(number) = trips.start() {
        let mut response = pin!(send(number)?);
        loop {
            match select(&mut response, pin!(patience.tick())).await {
                Either::Left((answer, _)) => {
                    trips.end(answer?);
                    break;
                }
                Either::Right(_) if trips.is_overdue() => {
                    trips.give_up()?;
                    break;
                }
                Either::Right(_) => {}
            }
        }
    }
    Ok(trips.measured())
}

// A loan stays in its thread, so that no future that may leave it can hold one while it waits.

fn request<S: Service<Request: Frame>>(client: &Client<S>, number: u64) -> Result<PendingResponse<S>> {
    let mut request = client.loan()?;
    stamp(number).write(request.bytes_mut(), false);
    Ok(client.send(request).map_err(|error| error.to_string())?)
}

fn respond<S: Service<Request: Frame, Response = Frame64B>>(
    service: &Server<S>,
    request: &Request<S>,
) -> Result<()> {
    let mut response = service.loan(request)?;
    stamp(number_of(&***request)?).write(&mut response.bytes, false);
    response.send().map_err(|error| error.to_string().into())
}

fn respond_owned<S: Service<Request: Frame, Response = Frame64B>>(request: ServiceRequest<S>) -> Result<()> {
    let mut message = Frame64B { bytes: [0; 64] };
    stamp(number_of(&request.message)?).write(&mut message.bytes, false);
    request.respond(message).map_err(|error| error.to_string().into())
}

fn stamp(number: u64) -> Stamp {
    Stamp { number, sent_ns: monotonic_ns() }
}

fn number_of(message: &impl Frame) -> Result<u64> {
    Ok(Stamp::read(message.bytes(), false)?.number)
}
