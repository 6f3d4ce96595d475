// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks that wait for messages of several others: when they run, how long a message waits, how many wait.
//!
//! Symbols: an input i of a join is a topic, and k one of the streams that reach it, one for each publisher and trigger. A stream has
//! period T_k, nominal releases r_k(n), and each message arrives within [`least_k`, `most_k`] after its own, where most - least is
//! the jitter J_k. What a message waits for is its *activation*, the arrival of the last message that is needed; the join's
//! response time counts from there. R_k is the longest response of the join's thread to a message. Messages come at their period, none
//! is lost, and every publisher has begun to send.
//!
//! **Several streams in one** (`union`). In a window w come at most sum ceil((w + J_k) / T_k) <= w / T + C messages, where
//! 1 / T = sum 1 / T_k and C = sum (J_k + T_k - 1) / T_k. That is no more than ceil((w + J) / T) with J = T (C - 1) + 1, rounded up: a
//! stream with period T and jitter J. With one stream these are its own. Its longest gap is that of the stream with the shortest gap.
//!
//! **Newest of each** ([`Matching::Newest`]). It runs once every input has something new. Each activation but the first is
//! preceded by a message of every input since the one before, so m of them span at least m - 1 messages of the slowest: a
//! stream with its T and jitter J + T. A message waits at most for the longest gap of another input, min (T_k + J_k), and one that is in
//! a set no longer than the gap of its own: with the last message of a set, what has come until then is taken.
//! Of several publishers' queues each is taken in order, but not all of them: what came before a message of another one may be taken after it, and
//! be in the set instead, until all that had come is taken. The next set has something later, one gap and one R after that.
//!
//! **Newest taken** ([`Matching::NewestTaken`]): an executor of ROS 2 takes one message after the other, and others may have come. So each wait
//! may be R_i longer. The next message of i after one in a set comes within its gap, and is taken R_i later; it is not before the set is passed on.
//! The first message of k after a set comes within a gap of k after the set, and what is taken after that set came at most R_i before. Nothing is
//! left to be taken where a busy window begins, so sets are no more in it; and m - 1 of the m sets that are passed on in w have a message of the
//! slowest that came within w + R, which is as many as the activations above make, each passed on within R.
//!
//! **Exact stamps** ([`Matching::Exact`]). Each input is one stream: those of several publishers would meet by chance only, and each set
//! drops what is older. The inputs have their nominal releases in common, and messages with the same
//! n meet. The n-th activation lies within [max least, max most] after r(n); a message waits at most max most - `least_i`.
//!
//! **Close stamps** ([`Matching::Approximate`], message_filters' policy with a window w). A stamp is taken within S_k after
//! its nominal release. Stamps of a stream are at most G_k = T_k + S_k apart and processed within D_k = most_k + R_k after they were
//! taken. What an input has that is earlier than what was processed of it is refused, so the stamps that are *kept* ascend.
//!
//! - After any instant x, each input has something later processed by x + E_i, E_i = min (G_k + D_k): stream k has a stamp in
//!   (x, x + G_k], which is kept, or refused because something still later was.
//! - Kept stamps of an input are at most G_i = min (max G_k, E_i) apart. Let s and then s' of stream k' be kept. The first stamp of any
//!   stream k after s is processed no sooner than s': before s, it would have made s refused, and in between it would have been kept.
//!   For k' itself that means s' <= s + G_k', for the others that s' <= s + G_k + D_k, as a stamp is taken before it is processed.
//!
//! A set is passed on at the latest when each input has sent something later than the set's pivot p, that is by
//! p + max E; its stamps are no earlier than p - w. So
//!
//! ```text
//! from a stamp to the activation of its set            L = w + max min (G_k + most_k)
//! messages of i that wait: its stamps, of all streams, within          w + max E
//! activations: the union of each input's streams, delayed by up to L: the slowest one's T with jitters S_k + L
//! ```
//!
//! If w is at least all gaps but the longest, G*, sets never starve: the latest of the oldest messages after a set that ends
//! before x is by x + G* + max(w, G*) at the latest the pivot of the next (dropping early messages moves the latest of the
//! oldest only where the slowest input is dropped, to G* after what was dropped, which was w before the latest). So a message
//! with stamp x, or a later one of its input, is in a set by x + G* + max(w, G*) + max E; one that is refused has a later one. RTSS 2023
//! (Li et al., 'Worst-Case Latency Analysis of Message Synchronization in ROS') and RTCSA 2024 (Wu et al.) analyse the same policy, with
//! predicted arrivals and without windows; the bounds above are for windows and jitter, and checked against the policy itself.
//!
//! **First close stamps** ([`Matching::ApproximateEpsilon`], message_filters' `ApproximateEpsilonTime` with a tolerance w). A set is
//! passed on when its own last message is processed: as long as all of them are there, each input has something, so all before them
//! goes. L = w + max `most_k`. A message with stamp x waits only as long as another input has nothing later than x + w. Of two inputs
//! the first that is too early is dropped alone, as above, and sets come by x + G* + max(w, G*) + max `most_k`. Of three or more it takes
//! others with it, which may have belonged to the next set, and nothing bounds how often.
//!
//! **At the pace of the fastest** ([`Matching::LatestTime`]). Each activation is a message, so those of all inputs together bound them.
//! A message may be in sets until the next of its input is taken, for T_k + J_k + R_k. Each input is one stream. The rate of the fastest,
//! f, is estimated as 1 / (T_f + J_f + R_f) at least, as an average of what is no less, and that of another one as 1 / A_i at most,
//! A_i = max(T_i - J_i, least distance) - R_i. If that is always less, f is the pivot whenever it has sent something, so that each of its
//! messages is an activation; if not, the pivot is not known.
use super::model::{Join, Matching, System};
use crate::{AnalysisError, Release, Task};

/// The bounds of a join once every input has a sender, all in nanoseconds.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct JoinBound {
    /// For each of [`Join::inputs`]: from the arrival of a message that is in a set to that of the last one of the set.
    pub wait_ns: Vec<u64>,
    /// For each of [`Join::inputs`]: as [`wait_ns`](Self::wait_ns), to that of a set with this message or a later one of its input,
    /// whoever published it. `None`: sets may never come together, or for a long time not at the pace of the fastest.
    pub reflected_ns: Option<Vec<u64>>,
    /// The most messages of one input that wait (with exact stamps: the most different stamps), not counting one that just
    /// arrives.
    pub queue_size: u64,
    /// The inputs because of which [`reflected_ns`](Self::reflected_ns) is `None`, each with a distance in nanoseconds. With a window:
    /// those whose messages may be this far apart, more than the window, except the slowest. At the pace of the fastest: those whose
    /// messages may be this close, no more than the fastest's are apart. Empty where the policy alone is the reason.
    pub starved_by: Vec<(usize, u64)>,
}

/// How the releases of a callback lie to those of the first callback that leads to it.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Timing {
    /// The least time from the nominal release of the first callback to one of this callback.
    pub least_ns: u64,
    /// The longest time between two releases.
    pub gap_ns: u64,
    /// How late after its nominal release the first callback takes a stamp.
    pub stamp_ns: u64,
}

impl Timing {
    /// The timing of a callback with releases of its own. A message from outside was stamped before it came.
    pub fn of_own(task: &Task) -> Self {
        let gap_ns = task.period_ns.saturating_add(task.jitter_ns);
        Timing { least_ns: 0, gap_ns, stamp_ns: task.jitter_ns }
    }

    /// The timing of a callback that `source` triggers. The first callback may take the stamp until it ends, after `stamped_ns`.
    pub fn passed_on(
        self,
        source: &Task,
        task: &Task,
        least_transfer_ns: u64,
        stamped_ns: Option<u64>,
    ) -> Self {
        let least_ns = self.least_ns.saturating_add(source.bcet_ns).saturating_add(least_transfer_ns);
        let more = task.jitter_ns.saturating_sub(source.jitter_ns);
        let stamp_ns = stamped_ns.unwrap_or(self.stamp_ns);
        Timing { least_ns, gap_ns: self.gap_ns.saturating_add(more), stamp_ns }
    }
}

/// The messages that reach an input of a join from one publisher and one trigger.
struct Stream<'a> {
    task: &'a Task,
    timing: Timing,
    most_ns: u64,
    /// From the arrival of a message until its thread has processed it.
    response_ns: u64,
}

impl Stream<'_> {
    /// The longest distance of two stamps.
    fn stamp_gap_ns(&self) -> u64 {
        self.task.period_ns.saturating_add(self.timing.stamp_ns)
    }

    /// From an instant to the arrival of the message that is stamped next.
    fn next_arrival_ns(&self) -> u64 {
        self.stamp_gap_ns().saturating_add(self.most_ns)
    }

    /// From the stamp of a message until it is processed.
    fn processed_ns(&self) -> u64 {
        self.most_ns.saturating_add(self.response_ns)
    }
}

/// An input of a join: all streams that reach it.
struct Input<'a> {
    streams: Vec<Stream<'a>>,
}

impl<'a> Input<'a> {
    fn most(&self, of: impl Fn(&Stream<'a>) -> u64) -> u64 {
        self.streams.iter().map(of).max().unwrap_or(0)
    }

    fn least(&self, of: impl Fn(&Stream<'a>) -> u64) -> u64 {
        self.streams.iter().map(of).min().unwrap_or(0)
    }

    fn period_ns(&self) -> u64 {
        union_period(self.streams.iter().map(|stream| stream.task.period_ns))
    }

    /// The longest time without a message.
    fn gap_ns(&self) -> u64 {
        self.least(|stream| stream.timing.gap_ns)
    }

    /// The longest time until something later than an instant is processed.
    fn known_ns(&self) -> u64 {
        self.least(|stream| stream.stamp_gap_ns().saturating_add(stream.processed_ns()))
    }

    /// The longest distance of two stamps that are kept.
    fn stamp_gap_ns(&self) -> u64 {
        self.most(Stream::stamp_gap_ns).min(self.known_ns())
    }
}

/// The period of several streams together, rounded down.
fn union_period(periods: impl Iterator<Item = u64> + Clone) -> u64 {
    let mut several = periods.clone();
    if let (Some(only), None) = (several.next(), several.next()) {
        return only;
    }
    const FINE: u128 = 1 << 100;
    // Exact if the periods have a common multiple that is small enough.
    let multiple = periods.clone().try_fold(1_u64, |all, period| {
        let (mut a, mut b) = (all, period.max(1));
        while b > 0 {
            (a, b) = (b, a % b);
        }
        (all / a).checked_mul(period.max(1))
    });
    let whole = multiple.map_or(FINE, u128::from);
    let rate: u128 = periods.map(|period| whole.div_ceil(u128::from(period.max(1)))).sum();
    u64::try_from(whole / rate.max(1)).unwrap_or(u64::MAX).max(1)
}

/// Returns several streams as one, with the `jitter` of each, and `more` messages at any time.
fn union<'a, 'b: 'a>(
    streams: impl Iterator<Item = &'a Stream<'b>> + Clone,
    jitter: impl Fn(&Stream<'b>) -> u64,
    more: u64,
) -> Release {
    let period_ns = union_period(streams.clone().map(|stream| stream.task.period_ns));
    let period = u128::from(period_ns);
    let of = |stream: &Stream<'b>| {
        let own = u128::from(stream.task.period_ns.max(1));
        let all = u128::from(jitter(stream)) + own - 1;
        // `period * all / own`, rounded up, which 128 bits need not hold before it is divided.
        period * (all / own) + (period * (all % own)).div_ceil(own)
    };
    let all: u128 = streams.map(of).sum();
    let jitter = (all + 1 + period * u128::from(more)).saturating_sub(period);
    Release::periodic(period_ns).jitter(u64::try_from(jitter).unwrap_or(u64::MAX))
}

/// Returns a join's releases, how it lies to the nominal releases of its inputs, and its bounds.
pub(super) fn solve(
    join: &Join,
    tasks: &[Task],
    timings: &[Timing],
    response_ns: impl Fn(usize) -> u64,
    held: bool,
) -> (Release, Timing, JoinBound) {
    let stream = |i: usize| {
        let (task, timing) = (&tasks[i], timings[i]);
        let most_ns = timing.least_ns.saturating_add(task.jitter_ns);
        Stream { task, timing, most_ns, response_ns: response_ns(i) }
    };
    let input = |port| {
        let takers = join.inputs.iter().zip(&join.ports).filter(|(_, of)| **of == port);
        Input { streams: takers.map(|(taker, _)| stream(*taker)).collect() }
    };
    let inputs: Vec<Input<'_>> = (0..join.width()).map(input).collect();
    let (mut release, timing, bound) = match join.matching {
        Matching::Newest => newest(&inputs, |_| 0),
        Matching::NewestTaken => newest(&inputs, |stream| stream.response_ns),
        Matching::Exact => exact(&inputs),
        Matching::Approximate { window_ns } => {
            close(&inputs, window_ns, most(&inputs, |input| input.least(Stream::next_arrival_ns)), true)
        }
        Matching::ApproximateEpsilon { window_ns } => {
            let most_ns = most(&inputs, |input| input.most(|stream| stream.most_ns));
            close(&inputs, window_ns, most_ns, inputs.len() == 2)
        }
        Matching::LatestTime => latest(&inputs),
    };
    if held && join.matching != Matching::LatestTime {
        // However late messages are: each set needs one of the slowest input, of which no more come at once than had come and waited.
        let at_once = slowest(&inputs, |stream| stream.task.jitter_ns, bound.queue_size.saturating_add(1));
        release.jitter_ns = release.jitter_ns.max(at_once.jitter_ns);
    }
    (release, timing, bound.ordered(&join.ports))
}

impl Join {
    /// How many inputs it has.
    pub(super) fn width(&self) -> usize {
        self.ports.iter().max().map_or(0, |last| last.saturating_add(1))
    }
}

/// As [`JoinBound`], with the times by input and stream.
struct Found {
    wait_ns: Vec<Vec<u64>>,
    reflected_ns: Option<Vec<Vec<u64>>>,
    queue_size: u64,
    starved_by: Vec<(usize, u64)>,
}

impl Found {
    /// Returns the bound, with the times in the order in which the streams were given.
    fn ordered(self, ports: &[usize]) -> JoinBound {
        let ordered = |times: Vec<Vec<u64>>| {
            let mut times: Vec<_> = times.into_iter().map(Vec::into_iter).collect();
            ports.iter().map(|port| times[*port].next().unwrap_or(0)).collect()
        };
        JoinBound {
            wait_ns: ordered(self.wait_ns),
            reflected_ns: self.reflected_ns.map(ordered),
            queue_size: self.queue_size,
            starved_by: self.starved_by,
        }
    }
}

fn most<'a>(inputs: &[Input<'a>], of: impl Fn(&Input<'a>) -> u64) -> u64 {
    inputs.iter().map(of).max().unwrap_or(0)
}

/// Returns `of` for each stream of each input.
fn each(inputs: &[Input<'_>], of: impl Fn(usize, &Stream<'_>) -> u64) -> Vec<Vec<u64>> {
    let streams =
        |(i, input): (usize, &Input<'_>)| input.streams.iter().map(|stream| of(i, stream)).collect();
    inputs.iter().enumerate().map(streams).collect()
}

/// Returns the releases of the slowest input, with the `jitter` of its streams; of equally slow inputs, those with the least jitter.
fn slowest<'a>(inputs: &[Input<'a>], jitter: impl Fn(&Stream<'a>) -> u64, more: u64) -> Release {
    let releases = inputs.iter().map(|input| union(input.streams.iter(), &jitter, more));
    let slowest = releases.max_by_key(|release| (release.period_ns, std::cmp::Reverse(release.jitter_ns)));
    slowest.unwrap_or(Release::periodic(u64::MAX))
}

/// `taken` is how long a message may wait until it is taken, while a set is passed on without it.
fn newest(inputs: &[Input<'_>], taken: impl Fn(&Stream<'_>) -> u64) -> (Release, Timing, Found) {
    let release = slowest(inputs, |stream| stream.task.jitter_ns, 1);
    // Messages of several publishers may come at once.
    let apart = |input: &Input<'_>| match &input.streams[..] {
        [only] => only.task.min_distance_ns,
        _ => 0,
    };
    let apart = inputs.iter().map(apart).min().unwrap_or(0);
    let others = |i: usize| inputs.iter().enumerate().filter(move |(j, _)| *j != i);
    let wait = |i| others(i).map(|(_, input)| input.gap_ns()).max().unwrap_or(0);
    let later = |of: u64| of.saturating_add(most(inputs, |input| input.most(&taken)));
    let gap_ns = later(most(inputs, Input::gap_ns));
    // Of several publishers an earlier message may be taken after a later one, and be in the set instead.
    let overtaken = gap_ns.saturating_add(most(inputs, |input| input.most(|stream| stream.response_ns)));
    let overtaken = |i: usize| if inputs[i].streams.len() > 1 { overtaken } else { 0 };
    let bound = Found {
        wait_ns: each(inputs, |i, _| later(wait(i).min(inputs[i].gap_ns()))),
        reflected_ns: Some(each(inputs, |i, _| later(wait(i)).saturating_add(overtaken(i)))),
        queue_size: 1,
        starved_by: Vec::new(),
    };
    (release.min_distance(apart), Timing { gap_ns, ..Timing::default() }, bound)
}

fn exact(inputs: &[Input<'_>]) -> (Release, Timing, Found) {
    let least_ns = most(inputs, |input| input.most(|stream| stream.timing.least_ns));
    let most_ns = most(inputs, |input| input.most(|stream| stream.most_ns));
    let jitter_ns = most_ns.saturating_sub(least_ns);
    let wait_ns = each(inputs, |_, stream| most_ns.saturating_sub(stream.timing.least_ns));
    let period_ns = most(inputs, Input::period_ns);
    let first = inputs.iter().map(|input| input.least(|stream| stream.timing.least_ns)).min().unwrap_or(0);
    let waits = most(inputs, |input| input.most(Stream::processed_ns)).saturating_sub(first);
    let timing = Timing {
        least_ns,
        gap_ns: period_ns.saturating_add(jitter_ns),
        stamp_ns: most(inputs, |input| input.most(|stream| stream.timing.stamp_ns)),
    };
    let bound = Found {
        reflected_ns: Some(wait_ns.clone()),
        wait_ns,
        queue_size: Release::periodic(period_ns).most_within(waits.saturating_add(1)).max(1),
        starved_by: Vec::new(),
    };
    (Release::periodic(period_ns).jitter(jitter_ns), timing, bound)
}

/// `completed` is the longest time from the pivot of a set, no later than a window after its first stamp, to its activation. `meets`: sets do
/// not starve if the window is long enough.
fn close(inputs: &[Input<'_>], window_ns: u64, completed: u64, meets: bool) -> (Release, Timing, Found) {
    // Times to the activation itself, which is an arrival, and to the end of its processing in the thread.
    let activated = window_ns.saturating_add(completed);
    let known = most(inputs, Input::known_ns);
    // An arrival is at least `least` after its nominal release, a stamp at most S.
    let from_arrival = |from_stamp: u64| {
        each(inputs, |_, stream| {
            from_stamp.saturating_add(stream.timing.stamp_ns).saturating_sub(stream.timing.least_ns)
        })
    };
    let slow = (0..inputs.len()).max_by_key(|i| inputs[*i].stamp_gap_ns()).unwrap_or(0);
    let longest = most(inputs, Input::stamp_gap_ns);
    let others = inputs.iter().enumerate().filter(|(i, _)| meets && *i != slow);
    let apart = others.map(|(i, input)| (i, input.stamp_gap_ns()));
    let starved_by: Vec<_> = apart.filter(|(_, gap_ns)| *gap_ns > window_ns).collect();
    let reflected = longest.saturating_add(window_ns.max(longest)).saturating_add(completed);
    let held = window_ns.saturating_add(known).saturating_add(1);
    let waiting = |input: &Input<'_>| {
        let of = |stream: &Stream<'_>| {
            Release::periodic(stream.task.period_ns).jitter(stream.timing.stamp_ns).most_within(held)
        };
        input.streams.iter().map(of).fold(0, u64::saturating_add)
    };
    let gap = inputs.iter().map(Input::stamp_gap_ns).min().unwrap_or(0);
    let bound = Found {
        wait_ns: from_arrival(activated),
        reflected_ns: (meets && starved_by.is_empty()).then(|| from_arrival(reflected)),
        queue_size: most(inputs, waiting).max(1),
        starved_by,
    };
    let release = slowest(inputs, |stream| stream.timing.stamp_ns.saturating_add(activated), 0);
    // Where sets may starve, nothing that waits for this one has a bound.
    let gap_ns = if bound.reflected_ns.is_some() { gap.saturating_add(reflected) } else { u64::MAX };
    (release, Timing { gap_ns, ..Timing::default() }, bound)
}

fn latest(inputs: &[Input<'_>]) -> (Release, Timing, Found) {
    let release = union(inputs.iter().flat_map(|input| &input.streams), |stream| stream.task.jitter_ns, 0);
    let taken = |stream: &Stream<'_>| stream.timing.gap_ns.saturating_add(stream.response_ns);
    let fastest = (0..inputs.len()).min_by_key(|i| inputs[*i].period_ns()).unwrap_or(0);
    let pace = inputs.get(fastest).map_or(0, |input| input.least(taken));
    let apart = |stream: &Stream<'_>| {
        let nominal = stream.task.period_ns.saturating_sub(stream.task.jitter_ns);
        nominal.max(stream.task.min_distance_ns).saturating_sub(stream.response_ns)
    };
    let others = inputs.iter().enumerate().filter(|(i, _)| *i != fastest);
    let close = others.map(|(i, input)| (i, input.least(apart)));
    let starved_by: Vec<_> = close.filter(|(_, apart_ns)| *apart_ns <= pace).collect();
    let next = inputs.get(fastest).map_or(0, Input::gap_ns);
    let reflected = |i, stream: &Stream<'_>| {
        if i == fastest { 0 } else { next.saturating_add(stream.response_ns) }
    };
    let bound = Found {
        wait_ns: each(inputs, |i, _| inputs[i].least(taken)),
        reflected_ns: starved_by.is_empty().then(|| each(inputs, reflected)),
        queue_size: 1,
        starved_by,
    };
    let gap_ns = if bound.reflected_ns.is_some() { next } else { u64::MAX };
    (release, Timing { gap_ns, ..Timing::default() }, bound)
}

/// Refuses joins that have no meaning.
pub(super) fn validate(system: &System, join: &Join, name: &str) -> Result<(), AnalysisError> {
    let problem = |problem| Err(AnalysisError::BadJoin { task: name.to_owned(), problem });
    let takers = |port| join.ports.iter().filter(|of| **of == port).count();
    if join.ports.len() != join.inputs.len() || (0..join.width()).any(|port| takers(port) == 0) {
        return problem("its ports do not tell whose messages each of its callbacks takes");
    }
    if join.width() < 2 {
        return problem("it has fewer than two inputs");
    }
    if join.inputs.iter().any(|i| system.callbacks[*i].join.is_some()) {
        return problem("an input is a join itself, where a callback has to take its messages");
    }
    if join.inputs.iter().any(|i| system.callbacks[first(system, *i)].task.distances.is_some()) {
        return problem("an input has the releases of a trace, where joins need a period");
    }
    let several = join.width() < join.inputs.len();
    if several && join.matching == Matching::Exact {
        return problem("an input has several publishers, whose stamps are not equal to those of the others");
    }
    if several && join.matching == Matching::LatestTime {
        return problem("an input has several streams, so that it has no rate of its own");
    }
    let mut periods = join.inputs.iter().map(|i| period(system, *i));
    let first_period = periods.next();
    if join.matching == Matching::Exact && periods.any(|period| Some(period) != first_period) {
        return problem("its inputs have different periods, so that most stamps have no equal");
    }
    let by_stamp = !join.matching.is_newest() && join.matching != Matching::LatestTime;
    if by_stamp && join.inputs.iter().any(|i| system.callbacks[first(system, *i)].join.is_some()) {
        return problem("an input comes from a join, so that its stamps are not known");
    }
    Ok(())
}

/// Returns the first of the callbacks that trigger one another down to this one: one with releases of its own, or a join whose messages are
/// of several stamps.
pub(super) fn first(system: &System, mut index: usize) -> usize {
    loop {
        let callback = &system.callbacks[index];
        match (&callback.trigger, &callback.join) {
            (Some((source, _)), _) => index = *source,
            (None, Some(Join { inputs, matching: Matching::Exact, .. })) => index = inputs[0],
            _ => return index,
        }
    }
}

/// The period that a callback inherits.
pub(super) fn period(system: &System, index: usize) -> u64 {
    inherited(system, [index])[index].unwrap_or(0)
}

/// The period that each callback has or inherits.
pub(super) fn periods(system: &System) -> Vec<u64> {
    inherited(system, 0..system.callbacks.len()).into_iter().map(|period| period.unwrap_or(0)).collect()
}

/// The periods of these callbacks and of all on the way to them, each of which is visited once.
fn inherited(system: &System, wanted: impl IntoIterator<Item = usize>) -> Vec<Option<u64>> {
    let mut known: Vec<Option<u64>> = vec![None; system.callbacks.len()];
    for index in wanted {
        let mut path = vec![index];
        while let Some(&i) = path.last() {
            let callback = &system.callbacks[i];
            let missing = callback.predecessors().iter().find(|before| known[**before].is_none());
            if let (None, Some(before)) = (known[i], missing) {
                path.push(*before);
                continue;
            }
            path.pop();
            let of = |before: usize| known[before].unwrap_or(0);
            known[i] = Some(match (&callback.trigger, &callback.join) {
                (Some((source, _)), _) => of(*source),
                (None, Some(join)) => {
                    let port = |port: Option<usize>| {
                        let taken = join
                            .inputs
                            .iter()
                            .zip(&join.ports)
                            .filter(|(_, of)| port.is_none_or(|port| **of == port));
                        union_period(taken.map(|(input, _)| of(*input)).collect::<Vec<_>>().into_iter())
                    };
                    match join.matching {
                        Matching::LatestTime => port(None),
                        _ => (0..join.width()).map(|of| port(Some(of))).max().unwrap_or(0),
                    }
                }
                (None, None) => callback.task.period_ns,
            });
        }
    }
    known
}
