// SPDX-License-Identifier: MIT OR Apache-2.0
//! What each end does.

use std::mem::MaybeUninit;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use taktora_executor::{
    Context, ExecutableItem, ExecuteResult, Executor, ExecutorError, ItemFlow, Publisher, Subscriber,
    TriggerDeclarer, item_with_triggers,
};
use tautline_exchange::{Job, Line, Result, RoundTrips, Stamp, on_stop, say};
use tautline_rt::clock::monotonic_ns;

/// Words, so that a message begins where one does.
type Frame<const WORDS: usize> = [u64; WORDS];

/// How often it is looked whether an answer is overdue.
const LOOK: Duration = Duration::from_millis(20);

/// Sends first, and holds the clock.
pub fn ask<const WORDS: usize>(job: &Job) -> Result<()> {
    let own = job.clone();
    job.as_application(move || {
        let (mut executor, [to, from]) = (executor()?, own.topics());
        let out = Outlet::<WORDS>::open(&mut executor, &own, &to)?;
        let asking = Arc::new(Mutex::new(Asking { trips: RoundTrips::new(&own), out }));
        let answered = asking.clone();
        let then = move |stamp: Stamp, context: &Context<'_>| {
            let mut asking = answered.lock().unwrap_or_else(PoisonError::into_inner);
            if asking.trips.end(stamp.number) { asking.next(context) } else { Ok(()) }
        };
        let subscriber = subscriber::<WORDS>(&mut executor, &from)?;
        executor.add(Callback { subscriber, whole: own.way.whole, then })?;
        let overdue = asking.clone();
        let mut is_first = true;
        let look = move |context: &mut Context<'_>| -> ExecuteResult {
            let mut asking = overdue.lock().unwrap_or_else(PoisonError::into_inner);
            if is_first {
                is_first = false;
                asking.next(context)?;
            } else if asking.trips.is_overdue() {
                asking.trips.give_up()?;
                asking.next(context)?;
            }
            Ok(ItemFlow::Continue)
        };
        executor.add(item_with_triggers(
            |triggers| {
                triggers.interval(LOOK);
                Ok(())
            },
            look,
        ))?;
        executor.run()?;
        drop(executor);
        let asking = Arc::into_inner(asking).ok_or("an item is still there")?;
        let asking = asking.into_inner().unwrap_or_else(PoisonError::into_inner);
        say(&Line::Measured(asking.trips.measured()));
        Ok(())
    })
}

struct Asking<const WORDS: usize> {
    trips: RoundTrips,
    out: Outlet<WORDS>,
}

impl<const WORDS: usize> Asking<WORDS> {
    fn next(&mut self, context: &Context<'_>) -> Result<()> {
        match self.trips.start() {
            Some(number) => self.out.send(Stamp { number, sent_ns: monotonic_ns() }),
            None => {
                context.stop_executor();
                Ok(())
            }
        }
    }
}

/// Answers from within its item.
pub fn answer<const WORDS: usize>(job: &Job) -> Result<()> {
    let own = job.clone();
    job.as_application(move || {
        let (mut executor, [to, from]) = (executor()?, own.topics());
        let out = Outlet::<WORDS>::open(&mut executor, &own, &to)?;
        let answer = move |stamp: Stamp, _: &Context<'_>| {
            out.send(Stamp { number: stamp.number, sent_ns: monotonic_ns() })
        };
        let subscriber = subscriber::<WORDS>(&mut executor, &from)?;
        executor.add(Callback { subscriber, whole: own.way.whole, then: answer })?;
        run_until_stop(&mut executor, &own)
    })
}

/// Runs the items in the calling thread, whose priority and core they have.
fn executor() -> Result<Executor> {
    Ok(Executor::builder().worker_threads(0).build()?)
}

fn run_until_stop(executor: &mut Executor, job: &Job) -> Result<()> {
    let stoppable = executor.stoppable();
    on_stop(move || stoppable.stop());
    say(&Line::Ready(job.endpoint.clone()));
    Ok(executor.run()?)
}

fn subscriber<const WORDS: usize>(executor: &mut Executor, topic: &str) -> Result<Subscriber<Frame<WORDS>>> {
    Ok(executor.channel::<Frame<WORDS>>(topic)?.subscriber()?)
}

struct Outlet<const WORDS: usize> {
    publisher: Publisher<Frame<WORDS>>,
    whole: bool,
}

impl<const WORDS: usize> Outlet<WORDS> {
    fn open(executor: &mut Executor, job: &Job, topic: &str) -> Result<Self> {
        let publisher = executor.channel::<Frame<WORDS>>(topic)?.publisher()?;
        Ok(Outlet { publisher, whole: job.way.whole })
    }

    fn send(&self, stamp: Stamp) -> Result<()> {
        self.publisher.loan(|frame| {
            let bytes: *mut MaybeUninit<u8> = frame.as_mut_ptr().cast();
            // SAFETY: the frame's own memory, borrowed while this is.
            let bytes = unsafe { std::slice::from_raw_parts_mut(bytes, size_of::<Frame<WORDS>>()) };
            // Of a payload that is not written whole the rest is as the kernel made it, zeroes.
            stamp.write_uninit(bytes, self.whole);
            true
        })?;
        Ok(())
    }
}

/// An item that is triggered by its subscriber.
struct Callback<const WORDS: usize, F> {
    subscriber: Subscriber<Frame<WORDS>>,
    whole: bool,
    then: F,
}

impl<const WORDS: usize, F> ExecutableItem for Callback<WORDS, F>
where
    F: FnMut(Stamp, &Context<'_>) -> Result<()> + Send + 'static,
{
    fn declare_triggers(
        &mut self,
        triggers: &mut TriggerDeclarer<'_>,
    ) -> std::result::Result<(), ExecutorError> {
        triggers.subscriber(&self.subscriber);
        Ok(())
    }

    fn execute(&mut self, context: &mut Context<'_>) -> ExecuteResult {
        while let Some(sample) = self.subscriber.take()? {
            let frame: *const u8 = sample.payload().as_ptr().cast();
            // SAFETY: the sample's own memory, borrowed while it is there.
            let bytes = unsafe { std::slice::from_raw_parts(frame, size_of::<Frame<WORDS>>()) };
            let stamp = Stamp::read(bytes, self.whole)?;
            drop(sample);
            (self.then)(stamp, context)?;
        }
        Ok(ItemFlow::Continue)
    }
}
