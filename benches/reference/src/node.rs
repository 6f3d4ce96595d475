// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a node does with its messages, whatever brings them.

use std::future::poll_fn;
use std::hint::black_box;
use std::ops::Deref;
use std::sync::Arc;
use std::task::Poll;

use futures::{Stream, StreamExt};
use tautline_rt::clock::monotonic_ns;

use crate::graph::{CALLBACKS, Callback, ESTIMATOR, FRONT_LIDAR, PLANNER, REAR_LIDAR, Trigger};
use crate::{Message4kb, Records, TransmissionStats, number_cruncher};

/// A subscription: a stream of messages.
pub trait Input: Stream<Item: Deref<Target = Message4kb>> + Unpin {
    /// The latest message, if one has come since the last was taken, without waiting.
    fn latest(&mut self) -> Option<Self::Item>;
}

pub trait Output {
    /// Publishes what `fill` writes into a message. What was there before means nothing.
    fn publish(&mut self, fill: impl FnOnce(&mut Message4kb));
}

/// Runs callback `index` of [`CALLBACKS`] for ever. It counts primes up to `cruncher_limit` each time. A callback with a period
/// has a `timer`, and runs until that ends.
pub async fn run<I: Input, O: Output>(
    index: usize,
    cruncher_limit: u64,
    records: Arc<Records>,
    mut timer: Option<impl Stream + Unpin>,
    mut inputs: Vec<I>,
    mut output: Option<O>,
) {
    let mut worker = Worker::new(index, cruncher_limit, records);
    let mut cache: Vec<Option<I::Item>> = inputs.iter().map(|_| None).collect();
    loop {
        match worker.callback.trigger {
            Trigger::Period(_) => {
                let Some(timer) = &mut timer else { return };
                if timer.next().await.is_none() {
                    return;
                }
                inputs.iter_mut().zip(&mut cache).for_each(|(input, place)| *place = input.latest());
            }
            Trigger::Any | Trigger::All => {
                let (input, message) = next_of(&mut inputs).await;
                cache[input] = Some(message);
            }
        }
        if worker.callback.trigger == Trigger::All && cache.iter().any(Option::is_none) {
            continue;
        }
        worker.run(&cache, output.as_mut());
        cache.fill_with(|| None);
    }
}

async fn next_of<I: Input>(inputs: &mut [I]) -> (usize, I::Item) {
    poll_fn(|context| {
        for (index, input) in inputs.iter_mut().enumerate() {
            if let Poll::Ready(Some(message)) = input.poll_next_unpin(context) {
                return Poll::Ready((index, message));
            }
        }
        Poll::Pending
    })
    .await
}

struct Worker {
    index: usize,
    callback: Callback,
    cruncher_limit: u64,
    records: Arc<Records>,
    sequence_number: u32,
    /// Of the last message of each input.
    seen: Vec<Option<u32>>,
}

impl Worker {
    fn new(index: usize, cruncher_limit: u64, records: Arc<Records>) -> Self {
        let callback = CALLBACKS[index];
        let seen = vec![None; callback.inputs.len()];
        Worker { index, callback, cruncher_limit, records, sequence_number: 0, seen }
    }

    fn run<M: Deref<Target = Message4kb>>(&mut self, inputs: &[Option<M>], output: Option<&mut impl Output>) {
        let started_ns = monotonic_ns();
        let dropped = self.count_dropped(inputs);
        let primes = if self.callback.works { number_cruncher(black_box(self.cruncher_limit)) } else { 0 };
        let mut origins_ns = [None; 2];
        if let Some(output) = output {
            let own = TransmissionStats::new(self.callback.node, started_ns, self.sequence_number, dropped);
            let is_estimator = self.callback.name == ESTIMATOR;
            output.publish(|message| {
                message.clear();
                inputs.iter().flatten().for_each(|input| message.merge(input));
                message.append(own);
                message.data[0] = primes as i64;
                if is_estimator {
                    origins_ns = [FRONT_LIDAR, REAR_LIDAR]
                        .map(|lidar| message.entry_of(lidar).map(|entry| entry.timestamp));
                }
            });
            self.sequence_number = self.sequence_number.wrapping_add(1);
        }
        self.note(started_ns, dropped, origins_ns);
    }

    /// Messages of the inputs that were published since the last one that was seen, and not seen.
    fn count_dropped<M: Deref<Target = Message4kb>>(&mut self, inputs: &[Option<M>]) -> u32 {
        let mut dropped = 0;
        for (input, seen) in inputs.iter().zip(&mut self.seen) {
            // Who published it has made the last entry.
            let Some(entry) = input.as_ref().and_then(|message| message.entries().last()) else { continue };
            let now = entry.sequence_number;
            dropped += seen.map_or(0, |before| now.wrapping_sub(before).saturating_sub(1));
            *seen = Some(now);
        }
        dropped
    }

    /// Writes the run down if it is one that counts: one that began in the window, or, for the hot path, one whose front-lidar
    /// sample was taken in it.
    fn note(&self, started_ns: u64, dropped: u32, [front_ns, rear_ns]: [Option<u64>; 2]) {
        let window = &self.records.window;
        if window.contains(started_ns) {
            self.records.note_run(self.index, dropped);
            if self.callback.name == PLANNER {
                self.records.planner_starts_ns.note(started_ns);
            }
        }
        if let Some(front_ns) = front_ns.filter(|&front_ns| window.contains(front_ns)) {
            let now_ns = monotonic_ns();
            self.records.hot_path_ns.note(now_ns - front_ns);
            self.records.both_lidars_ns.note(now_ns - rear_ns.unwrap_or(front_ns).min(front_ns));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Window;
    use futures::channel::mpsc::{UnboundedReceiver, UnboundedSender, unbounded};
    use futures::executor::LocalPool;
    use futures::stream;
    use futures::task::LocalSpawnExt;

    impl Input for UnboundedReceiver<Box<Message4kb>> {
        fn latest(&mut self) -> Option<Self::Item> {
            std::iter::from_fn(|| self.try_recv().ok()).last()
        }
    }

    impl Output for UnboundedSender<Box<Message4kb>> {
        fn publish(&mut self, fill: impl FnOnce(&mut Message4kb)) {
            let mut message = Box::new(Message4kb::EMPTY);
            fill(&mut message);
            self.unbounded_send(message).unwrap();
        }
    }

    /// A callback of the graph with a sender for each input, and what it publishes.
    struct Bench {
        pool: LocalPool,
        inputs: Vec<UnboundedSender<Box<Message4kb>>>,
        timer: UnboundedSender<()>,
        output: UnboundedReceiver<Box<Message4kb>>,
        records: Arc<Records>,
        index: usize,
    }

    impl Bench {
        fn of(name: &str) -> Bench {
            let records =
                Arc::new(Records::new(Window { begin_ns: 0, end_ns: monotonic_ns() + 60_000_000_000 }));
            let index = CALLBACKS.iter().position(|callback| callback.name == name).unwrap();
            let (inputs, receivers) = CALLBACKS[index].inputs.iter().map(|_| unbounded()).unzip();
            let (timer, ticks) = unbounded();
            let (out, output) = unbounded();
            let pool = LocalPool::new();
            let node =
                run::<UnboundedReceiver<_>, _>(index, 10, records.clone(), Some(ticks), receivers, Some(out));
            pool.spawner().spawn_local(node).unwrap();
            Bench { pool, inputs, timer, output, records, index }
        }

        fn send(&self, input: usize, node: &str, sequence: u32) {
            let mut message = Message4kb::EMPTY;
            message.append(TransmissionStats::new(node, 5, sequence, 0));
            self.inputs[input].unbounded_send(Box::new(message)).unwrap();
        }

        /// What was published since, as names and sequence numbers of the entries.
        fn published(&mut self) -> Vec<Vec<(String, u32)>> {
            self.pool.run_until_stalled();
            let text = |name: &[u8]| String::from_utf8_lossy(name).trim_end_matches('\0').to_owned();
            let of = |message: Box<Message4kb>| {
                message
                    .entries()
                    .iter()
                    .map(|entry| (text(&entry.node_name), entry.sequence_number))
                    .collect()
            };
            std::iter::from_fn(|| self.output.try_recv().ok()).map(of).collect()
        }

        fn counts(&self) -> (u64, u64) {
            self.records.counts(self.index)
        }
    }

    fn entries(list: &[(&str, u32)]) -> Vec<(String, u32)> {
        list.iter().map(|&(name, sequence)| (name.to_owned(), sequence)).collect()
    }

    #[test]
    fn a_fusion_waits_for_both_takes_the_latest_and_forgets_them() {
        let mut bench = Bench::of("PointCloudFusion");
        bench.send(0, "front", 0);
        assert!(bench.published().is_empty(), "one input is not enough");
        bench.send(0, "front", 1);
        bench.pool.run_until_stalled();
        bench.send(1, "rear", 0);
        assert_eq!(bench.published(), [entries(&[("front", 1), ("rear", 0), ("PointCloudFusion", 0)])]);
        bench.send(1, "rear", 1);
        assert!(bench.published().is_empty(), "both were forgotten");
        bench.send(0, "front", 2);
        assert_eq!(bench.published(), [entries(&[("front", 2), ("rear", 1), ("PointCloudFusion", 1)])]);
        assert_eq!(bench.counts().0, 2);
    }

    #[test]
    fn messages_that_never_came_are_counted_by_their_numbers() {
        let mut bench = Bench::of("RayGroundFilter");
        for sequence in [3, 4, 8, 9, 11] {
            bench.send(0, "PointCloudFusion", sequence);
        }
        assert_eq!(bench.published().len(), 5);
        assert_eq!(bench.counts(), (5, 4), "5, 6, 7 and 10; what was before the first is not known");
    }

    #[test]
    fn a_fusion_counts_what_it_replaced_as_dropped() {
        let mut bench = Bench::of("NDTLocalizer");
        bench.send(1, "map", 0);
        for sequence in 0..3 {
            bench.send(0, "voxels", sequence);
            bench.pool.run_until_stalled();
        }
        // The first met the map; two wait for the next map, and one of them in vain.
        bench.send(1, "map", 1);
        assert_eq!(bench.published().len(), 2);
        assert_eq!(bench.counts(), (2, 1));
    }

    #[test]
    fn a_cyclic_node_takes_the_latest_at_its_tick_and_publishes_without_inputs_too() {
        let mut bench = Bench::of(PLANNER);
        bench.send(5, "LanePlanner", 0);
        bench.send(5, "LanePlanner", 1);
        assert!(bench.published().is_empty(), "it is not its time");
        bench.timer.unbounded_send(()).unwrap();
        assert_eq!(bench.published(), [entries(&[("LanePlanner", 1), (PLANNER, 0)])]);
        bench.timer.unbounded_send(()).unwrap();
        assert_eq!(bench.published(), [entries(&[(PLANNER, 1)])]);
        assert_eq!(bench.records.planner_starts_ns.to_vec().len(), 2);
    }

    #[test]
    fn the_hot_path_is_measured_where_a_front_lidar_sample_ends() {
        let mut bench = Bench::of(ESTIMATOR);
        bench.send(0, "EuclideanClusterDetector", 0);
        assert_eq!(bench.published().len(), 1);
        assert!(bench.records.hot_path_ns.to_vec().is_empty(), "of no lidar");
        let mut fused = Message4kb::EMPTY;
        fused.append(TransmissionStats::new(FRONT_LIDAR, 105, 1, 0));
        fused.append(TransmissionStats::new(REAR_LIDAR, 5, 1, 0));
        bench.inputs[0].unbounded_send(Box::new(fused)).unwrap();
        assert_eq!(bench.published().len(), 1);
        let (front, both) = (bench.records.hot_path_ns.to_vec(), bench.records.both_lidars_ns.to_vec());
        assert_eq!(front.len(), 1);
        assert_eq!(both, [front[0] + 100], "from the lidar that came first");
    }

    #[test]
    fn a_sensor_needs_its_timer_only() {
        let records = Arc::new(Records::new(Window { begin_ns: 0, end_ns: 1 }));
        let (out, mut output) = unbounded();
        let index = CALLBACKS.iter().position(|callback| callback.name == FRONT_LIDAR).unwrap();
        let ticks = stream::iter([(), ()]);
        let none: Vec<UnboundedReceiver<Box<Message4kb>>> = Vec::new();
        futures::executor::block_on(run(index, 10, records.clone(), Some(ticks), none, Some(out)));
        assert_eq!(output.try_recv().unwrap().data[0], 0, "it does not count primes");
        assert_eq!(records.counts(index), (0, 0), "it ran outside of the window");
    }
}
