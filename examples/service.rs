//! A service and its client: requests and responses written and read in shared memory, at a priority of their own.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use std::time::Duration;
use tautline::example_interfaces::srv::AddTwoInts;
use tautline::{CallbackOptions, Error, Node, Qos, Result, ServiceError};
use tautline_examples::{context, exit_code};

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context()?;
    let mut node = Node::create(context.clone(), "service", "")?;
    let qos = Qos::default();
    let client = node.create_client::<AddTwoInts::Service>("add_two_ints")?;

    // Nobody serves it yet: that is said, rather than waited for.
    if let Err(error @ Error::Service(ServiceError::NoServer { .. })) =
        client.request(&AddTwoInts::Request { a: 1, b: 2 })
    {
        println!("{error}");
    }
    let available = client.wait_for_service()?;

    let mut service = node.create_service::<AddTwoInts::Service>("add_two_ints", qos)?;
    let serve = node.spawn_callback(CallbackOptions::fifo(20).name("serve"), async move {
        while let Some(request) = service.next().await {
            if request.a < 0 {
                continue; // what is not answered keeps its client waiting
            }
            let Ok(mut response) = service.loan(&request) else { continue };
            response.sum = request.a + request.b; // both in shared memory
            if let Err(unsent) = response.send() {
                println!("{unsent}");
            }
        }
    })?;
    let in_place = node.create_client::<AddTwoInts::Service>("add_two_ints")?;
    let ask = node.spawn_callback(CallbackOptions::fifo(10).name("ask"), async move {
        let asked = async move {
            available.await?;
            let response = client.request(&AddTwoInts::Request { a: 1, b: 2 })?.await?;
            println!("owned:    1 + 2 = {}", response.sum);

            let response = {
                let mut request = in_place.loan()?; // a loan stays in its thread: it is gone before the wait
                (request.a, request.b) = (40, 2);
                in_place.send(request)?
            };
            let response = response.await?;
            println!("in place: 40 + 2 = {}", response.sum);

            let limit = Duration::from_millis(50);
            client.request_timeout(&AddTwoInts::Request { a: -1, b: 0 }, limit)?.await?;
            Ok::<(), Error>(())
        };
        if let Err(error) = asked.await {
            println!("{error}");
        }
        context.shutdown();
    })?;
    node.spin()?;
    serve.stop(); // it would wait for more
    serve.join()?;
    Ok(ask.join()?)
}
