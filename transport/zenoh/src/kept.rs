// SPDX-License-Identifier: MIT OR Apache-2.0
//! Orders the kept and the new samples of transient-local publishers: a publisher's kept samples are requested when it appears,
//! and its lost samples when a later one arrives; until the response, its new samples wait.
//!
//! zenoh-ext's `AdvancedSubscriber` is not used: it delivers a new sample that arrives during a request at once, and then drops
//! older kept samples without counting them (1.10.2).

use crate::unclaimed::{self, MOST_BYTES};
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fmt;
use std::str::FromStr;
use zenoh::sample::Sample;
use zenoh::session::ZenohId;

pub(crate) type SessionId = [u8; 16];

/// A publisher, as zenoh-ext identifies it: by its session and its number in the session. `None`: all publishers of the session whose
/// samples have only a time stamp.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Publisher(SessionId, Option<u32>);

impl Publisher {
    /// Parses the key of a publisher's token, `<topic>/@adv/pub/<session>/<number or uhlc>/<metadata>`. `None` for publishers of the
    /// session `own`.
    pub(crate) fn of_token(key: &str, own: ZenohId) -> Option<Self> {
        let (_, publisher) = key.rsplit_once("/@adv/pub/")?;
        let mut parts = publisher.split('/');
        let session = ZenohId::from_str(parts.next()?).ok().filter(|session| *session != own)?;
        let number = match parts.next()? {
            "uhlc" => None,
            number => Some(number.parse().ok()?),
        };
        Some(Publisher(session.to_le_bytes(), number))
    }

    pub(crate) fn is_single(&self) -> bool {
        self.1.is_some()
    }
}

/// The publishers whose kept samples are requested.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Target {
    Publisher(Publisher),
    Session(SessionId),
}

impl Target {
    pub(crate) fn includes(&self, publisher: Publisher) -> bool {
        match self {
            Target::Publisher(one) => *one == publisher,
            Target::Session(session) => *session == publisher.0,
        }
    }
}

/// The form that the keys of caches use.
impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Target::Publisher(Publisher(session, _)) | Target::Session(session)) = self;
        let session = ZenohId::try_from(&session[..]).map_err(|_| fmt::Error)?;
        match self {
            Target::Publisher(Publisher(_, Some(number))) => write!(f, "{session}/{number}"),
            Target::Publisher(Publisher(_, None)) => write!(f, "{session}/uhlc"),
            Target::Session(_) => write!(f, "{session}"),
        }
    }
}

/// A sample with a position among the samples of its publisher.
pub(crate) trait Placed {
    /// The publisher, and a number that grows with each of its samples; modulo 2^32 if the publisher has a number. `None`: unknown.
    fn place(&self) -> Option<(Publisher, u64)>;
    /// Its memory while it waits, in bytes.
    fn len_bytes(&self) -> usize;
}

impl Placed for Sample {
    fn place(&self) -> Option<(Publisher, u64)> {
        match (self.source_info(), self.timestamp()) {
            (Some(info), _) => {
                let id = info.source_id();
                Some((Publisher(id.zid().to_le_bytes(), Some(id.eid())), info.source_sn().into()))
            }
            (None, Some(time)) => {
                Some((Publisher(time.get_id().to_le_bytes(), None), time.get_time().as_u64()))
            }
            (None, None) => None,
        }
    }

    fn len_bytes(&self) -> usize {
        unclaimed::bytes(self)
    }
}

/// How far `number` is after `base`; negative if it is before `base`.
fn after(publisher: Publisher, number: u64, base: u64) -> i64 {
    match publisher.is_single() {
        true => i64::from((number as u32).wrapping_sub(base as u32) as i32),
        false => number.wrapping_sub(base) as i64,
    }
}

/// A request to a publisher's cache, after which [`KeptSamples::answered`] must be called, or to all caches of a session, after which
/// [`KeptSamples::answered_by_session`] must be called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Request {
    pub(crate) target: Target,
    pub(crate) what: What,
    /// Maximum of samples in the response.
    pub(crate) most: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum What {
    /// This number of last samples of each publisher.
    Last(usize),
    /// All kept samples from this number on.
    From(u32),
}

impl What {
    /// The selector parameters for zenoh-ext's caches.
    pub(crate) fn parameters(self) -> String {
        match self {
            What::Last(count) => format!("_max={count}"),
            What::From(number) => format!("_sn={number}.."),
        }
    }
}

/// The response to a request while it arrives: of what a publisher sends, the last samples that there is room for.
pub(crate) struct Response<S> {
    pub(crate) samples: VecDeque<S>,
    bytes: usize,
    /// The number of requested samples that are dropped, because later ones need their memory.
    pub(crate) dropped: u64,
}

impl<S> Default for Response<S> {
    fn default() -> Self {
        let (samples, bytes, dropped) = Default::default();
        Response { samples, bytes, dropped }
    }
}

impl<S: Placed> Response<S> {
    pub(crate) fn push(&mut self, sample: S, request: &Request) {
        self.bytes += sample.len_bytes();
        self.samples.push_back(sample);
        // A publisher may send more samples than requested.
        let is_more = self.samples.len() > request.most;
        while self.samples.len() > request.most || (self.bytes > MOST_BYTES && self.samples.len() > 1) {
            self.bytes -= self.samples.pop_front().as_ref().map_or(0, S::len_bytes);
            self.dropped += u64::from(!is_more);
        }
    }
}

/// The state of a topic's publishers.
pub(crate) struct KeptSamples<S> {
    /// Number of kept samples that are requested from each publisher.
    depth: usize,
    /// Whether lost samples are requested.
    recovers: bool,
    /// Whether the existing publishers are not known yet: all samples wait.
    is_starting: bool,
    publishers: HashMap<Publisher, PublisherState<S>>,
}

struct PublisherState<S> {
    /// Number of requests without a response.
    requests: usize,
    /// Whether new samples wait for a response.
    is_waiting: bool,
    /// New samples that wait; at most as many as a response has, because more of them replace all kept samples, and at most
    /// `MOST_BYTES`.
    waiting: Vec<S>,
    waiting_bytes: usize,
    /// The numbers of the first and of the last delivered sample.
    delivered: Option<(u64, u64)>,
    /// Whether samples before the first delivered one are not counted as lost: after a response, or when new samples replaced it.
    is_whole: bool,
    /// Whether a response had a sample of this publisher.
    is_answered: bool,
    /// The first number of the last request for lost samples: samples that the publisher no longer has are not requested again.
    asked: Option<u32>,
}

impl<S: Placed> KeptSamples<S> {
    /// Maximum of publishers; of further ones, which a hostile peer can announce, nothing is requested or ordered.
    const MOST: usize = 1024;
    /// Maximum of pending requests to a publisher: after its host was unreachable, an earlier one may still be pending.
    const REQUESTS: usize = 2;
    /// Assumed maximum of publishers of one session whose caches answer a request together.
    const TOGETHER: usize = 64;

    pub(crate) fn new(depth: usize, recovers: bool) -> Self {
        KeptSamples { depth, recovers, is_starting: true, publishers: HashMap::new() }
    }

    /// Takes over the new samples that wait in `former`, at the start: nobody else has those of volatile publishers.
    pub(crate) fn take_over(&mut self, former: Self) {
        let waiting = former.publishers.into_iter().filter(|(_, state)| !state.waiting.is_empty());
        self.publishers.extend(waiting.map(|(publisher, PublisherState { waiting, waiting_bytes, .. })| {
            (publisher, PublisherState { waiting, waiting_bytes, ..PublisherState::default() })
        }));
    }

    fn most(&self, publisher: Publisher) -> usize {
        if publisher.is_single() { self.depth } else { self.depth.saturating_mul(Self::TOGETHER) }
    }

    pub(crate) fn appeared(&mut self, publisher: Publisher) -> Option<Request> {
        self.request(publisher, What::Last(self.depth))
    }

    /// Its successor in the session has to answer for itself.
    pub(crate) fn ended(&mut self, publisher: Publisher) {
        if let Some(state) = self.publishers.get_mut(&publisher) {
            state.is_answered = false;
        }
    }

    fn request(&mut self, publisher: Publisher, what: What) -> Option<Request> {
        let most = self.most(publisher);
        let state = self.state(publisher).filter(|state| state.requests < Self::REQUESTS)?;
        state.requests += 1;
        state.is_waiting = true;
        Some(Request { target: Target::Publisher(publisher), what, most })
    }

    /// Requests to the sessions of which not all publishers have answered. `keeping` is the number of each session's publishers that keep
    /// samples.
    pub(crate) fn missing(&self, keeping: &BTreeMap<SessionId, usize>) -> Vec<Request> {
        let answered = |session: &SessionId| {
            let of_session = |(publisher, state): &(&Publisher, &PublisherState<S>)| {
                publisher.0 == *session && state.is_answered
            };
            let answered = self.publishers.iter().filter(of_session);
            // Publishers without numbers have answered together.
            answered.fold(0, |sum: usize, (publisher, _)| {
                sum.saturating_add(if publisher.is_single() { 1 } else { usize::MAX })
            })
        };
        let missing = keeping.iter().filter(|(session, count)| answered(session) < **count);
        let most = self.depth.saturating_mul(Self::TOGETHER);
        missing
            .map(|(session, _)| Request {
                target: Target::Session(*session),
                what: What::Last(self.depth),
                most,
            })
            .collect()
    }

    /// Ends the start, after all existing publishers have [appeared](Self::appeared): delivers samples that wait for no response.
    pub(crate) fn started(&mut self, deliver: &mut impl FnMut(S)) {
        self.is_starting = false;
        for (publisher, state) in &mut self.publishers {
            if !state.is_waiting {
                state.advance(*publisher, false, deliver);
            }
        }
        // Times of volatile publishers of one session may be out of order.
        self.publishers.retain(|publisher, state| publisher.is_single() || state.requests > 0);
    }

    /// Handles a publisher's heartbeat, which has the number of its last sample. Returns a request for missing samples.
    pub(crate) fn heartbeat(&mut self, publisher: Publisher, number: u32) -> Option<Request> {
        let is_idle = self.recovers && !self.is_starting;
        let state = self.publishers.get(&publisher).filter(|state| is_idle && state.requests == 0)?;
        let what = match state.delivered {
            None => What::Last(self.depth),
            Some((_, last)) if after(publisher, number.into(), last) > 0 => What::From(next(last)),
            Some(_) => return None,
        };
        self.request(publisher, what)
    }

    /// Handles a new sample: passes the samples that are due now to `deliver`, in order. Returns a request for lost samples.
    ///
    /// # Real-time
    /// Two look-ups; one of [`MOST`](Self::MOST) publishers for each sample of a publisher beyond them. A sample that waits is stored on the
    /// heap; the one that fills the queue delivers all of it.
    pub(crate) fn published(&mut self, sample: S, deliver: &mut impl FnMut(S)) -> Option<Request> {
        let place = sample.place().filter(|(publisher, _)| {
            // Times of volatile publishers of one session may be out of order.
            publisher.is_single() || self.is_starting || self.publishers.contains_key(publisher)
        });
        let Some((publisher, number)) = place else {
            deliver(sample);
            return None;
        };
        let (is_starting, most) = (self.is_starting, self.most(publisher));
        let is_recovered = self.recovers && publisher.is_single() && most > 1;
        let Some(state) = self.state(publisher) else {
            deliver(sample);
            return None;
        };
        let last = state.waiting.last().and_then(S::place).map(|(_, last)| last);
        let last = last.or(state.delivered.map(|(_, last)| last));
        let ahead = last.map_or(1, |last| after(publisher, number, last));
        if !is_starting && !state.is_waiting {
            match last.filter(|_| is_recovered && ahead > 1 && state.requests == 0).map(next) {
                None => {
                    state.deliver(publisher, number, sample, deliver);
                    return None;
                }
                Some(from) => {
                    state.wait(sample);
                    state.asked = Some(from);
                    return self.request(publisher, What::From(from));
                }
            }
        }
        if ahead > 0 || !publisher.is_single() {
            state.wait(sample);
        }
        let is_replaced = state.waiting.len() >= most;
        if is_replaced || state.waiting_bytes > MOST_BYTES {
            state.advance(publisher, false, deliver);
            state.is_whole |= is_replaced;
        }
        None
    }

    /// Handles the response to a request: passes the kept samples to `deliver`, and then the samples that waited for them. Returns how
    /// many kept samples arrived too late, after newer ones, and a request for lost samples.
    pub(crate) fn answered(
        &mut self,
        publisher: Publisher,
        kept: Vec<S>,
        deliver: &mut impl FnMut(S),
    ) -> (u64, Option<Request>) {
        let (is_starting, recovers) = (self.is_starting, self.recovers);
        let Some(state) = self.publishers.get_mut(&publisher) else { return (0, None) };
        let late = state.deliver_kept(publisher, kept, deliver);
        state.requests = state.requests.saturating_sub(1);
        if is_starting {
            state.is_waiting = false;
            return (late, None);
        }
        let lost = state.advance(publisher, recovers && publisher.is_single(), deliver);
        (late, lost.and_then(|from| self.request(publisher, What::From(from))))
    }

    /// Handles the response of a session: delivers the kept samples of publishers without a pending request. Returns how many were late.
    pub(crate) fn answered_by_session(&mut self, kept: Vec<S>, deliver: &mut impl FnMut(S)) -> u64 {
        let mut by_publisher = HashMap::<Publisher, Vec<S>>::new();
        for sample in kept {
            if let Some((publisher, _)) = sample.place() {
                by_publisher.entry(publisher).or_default().push(sample);
            }
        }
        let mut late = 0;
        for (publisher, kept) in by_publisher {
            if let Some(state) = self.state(publisher).filter(|state| state.requests == 0) {
                late += state.deliver_kept(publisher, kept, deliver);
            }
        }
        late
    }

    fn state(&mut self, publisher: Publisher) -> Option<&mut PublisherState<S>> {
        if self.publishers.len() >= Self::MOST && !self.publishers.contains_key(&publisher) {
            self.publishers.retain(|_, state| state.requests > 0 || !state.waiting.is_empty());
            if self.publishers.len() >= Self::MOST {
                return None;
            }
        }
        Some(self.publishers.entry(publisher).or_default())
    }
}

/// The number after `last`.
fn next(last: u64) -> u32 {
    (last as u32).wrapping_add(1)
}

/// Sorts the samples of a publisher by number: caches of one session answer one after the other.
fn sort<S: Placed>(publisher: Publisher, samples: &mut [S]) {
    let number = |sample: &S| sample.place().map(|(_, number)| number);
    if let Some(base) = samples.iter().find_map(number) {
        samples.sort_by_key(|sample| number(sample).map(|number| after(publisher, number, base)));
    }
}

impl<S> Default for PublisherState<S> {
    fn default() -> Self {
        let (requests, is_waiting, waiting, waiting_bytes) = Default::default();
        let (delivered, is_whole, is_answered, asked) = Default::default();
        PublisherState {
            requests,
            is_waiting,
            waiting,
            waiting_bytes,
            delivered,
            is_whole,
            is_answered,
            asked,
        }
    }
}

impl<S: Placed> PublisherState<S> {
    fn wait(&mut self, sample: S) {
        self.waiting_bytes += sample.len_bytes();
        self.waiting.push(sample);
    }

    /// Delivers a sample, unless this or a newer sample was delivered before.
    fn deliver(&mut self, publisher: Publisher, number: u64, sample: S, deliver: &mut impl FnMut(S)) {
        match &mut self.delivered {
            None => self.delivered = Some((number, number)),
            Some((_, last)) if after(publisher, number, *last) > 0 => *last = number,
            Some(_) => return,
        }
        deliver(sample);
    }

    /// Delivers kept samples. Returns how many arrived too late.
    fn deliver_kept(&mut self, publisher: Publisher, mut kept: Vec<S>, deliver: &mut impl FnMut(S)) -> u64 {
        sort(publisher, &mut kept);
        let first = self.delivered.filter(|_| !self.is_whole).map(|(first, _)| first);
        let mut late = 0;
        for sample in kept {
            let Some((_, number)) = sample.place() else { continue };
            late += u64::from(first.is_some_and(|first| after(publisher, number, first) < 0));
            self.deliver(publisher, number, sample, deliver);
            self.is_answered = true;
        }
        // Without any, the publisher may not have been reached.
        self.is_whole |= self.is_answered;
        late
    }

    /// Delivers waiting samples; with `recovers`, up to the first gap that was not requested before, and returns the gap's first number.
    fn advance(&mut self, publisher: Publisher, recovers: bool, deliver: &mut impl FnMut(S)) -> Option<u32> {
        let mut waiting = std::mem::take(&mut self.waiting);
        self.waiting_bytes = 0;
        sort(publisher, &mut waiting);
        let mut waiting = waiting.into_iter();
        while let Some(sample) = waiting.next() {
            let Some((_, number)) = sample.place() else { continue };
            let gap = self.delivered.filter(|(_, last)| after(publisher, number, *last) > 1);
            let from = gap.map(|(_, last)| next(last)).filter(|from| recovers && self.asked != Some(*from));
            if from.is_some() {
                self.asked = from;
                std::iter::once(sample).chain(waiting).for_each(|sample| self.wait(sample));
                return from;
            }
            self.deliver(publisher, number, sample, deliver);
        }
        self.is_waiting = false;
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ONE: Publisher = Publisher([1; 16], Some(7));
    const OTHER: Publisher = Publisher([1; 16], Some(8));
    const BY_TIME: Publisher = Publisher([1; 16], None);

    type Test = Option<(Publisher, u64)>;

    impl Placed for Test {
        fn place(&self) -> Option<(Publisher, u64)> {
            *self
        }

        /// Large, from this number on.
        fn len_bytes(&self) -> usize {
            let is_large = self.is_some_and(|(_, number)| (LARGE..2 * LARGE).contains(&number));
            if is_large { MOST_BYTES / 2 } else { 0 }
        }
    }

    const LARGE: u64 = 1_000_000;

    /// When all publishers are known.
    fn kept(depth: usize) -> KeptSamples<Test> {
        let mut kept = KeptSamples::new(depth, true);
        kept.started(&mut |_| panic!("nothing was published"));
        kept
    }

    fn published(kept: &mut KeptSamples<Test>, publisher: Publisher, numbers: &[u64]) -> Vec<u64> {
        let mut delivered = Vec::new();
        for &number in numbers {
            let request =
                kept.published(Some((publisher, number)), &mut |sample| delivered.push(sample.unwrap().1));
            assert_eq!(request, None);
        }
        delivered
    }

    /// What is delivered, what is late, and from where lost samples are requested.
    fn answered(
        kept: &mut KeptSamples<Test>,
        publisher: Publisher,
        numbers: &[u64],
    ) -> (Vec<u64>, u64, Option<u32>) {
        let mut delivered = Vec::new();
        let answer = numbers.iter().map(|&number| Some((publisher, number))).collect();
        let (late, request) =
            kept.answered(publisher, answer, &mut |sample| delivered.push(sample.unwrap().1));
        (delivered, late, request.map(|request| from(Some(request))))
    }

    fn from(request: Option<Request>) -> u32 {
        match request.unwrap().what {
            What::From(number) => number,
            What::Last(_) => panic!("{request:?}"),
        }
    }

    #[test]
    fn what_is_new_waits_for_what_was_kept() {
        let mut kept = kept(3);
        let request = Request { target: Target::Publisher(ONE), what: What::Last(3), most: 3 };
        assert_eq!(kept.appeared(ONE), Some(request));
        assert_eq!(request.what.parameters(), "_max=3");
        assert!(published(&mut kept, ONE, &[2, 3]).is_empty());
        assert_eq!(published(&mut kept, OTHER, &[5]), [5], "of another publisher");
        assert_eq!(answered(&mut kept, ONE, &[1, 2, 3]), (vec![1, 2, 3], 0, None));
        assert_eq!(published(&mut kept, ONE, &[3, 4, 4, 5]), [4, 5]);
        let mut without = 0;
        kept.published(None, &mut |_| without += 1);
        assert_eq!(without, 1, "without a number");
        assert_eq!(published(&mut kept, BY_TIME, &[5, 4, 6]), [5, 4, 6], "of publishers that keep nothing");
        // Its host was away: what it kept since then comes, and nothing twice.
        assert!(kept.appeared(ONE).is_some());
        assert!(published(&mut kept, ONE, &[4, 5, 8]).is_empty());
        assert_eq!(answered(&mut kept, ONE, &[5, 6, 7]), (vec![6, 7, 8], 0, None));
    }

    #[test]
    fn at_the_start_all_wait_until_publishers_are_known() {
        let mut kept = KeptSamples::new(3, true);
        for (publisher, numbers) in [(ONE, [5, 6]), (OTHER, [7, 8]), (BY_TIME, [2, 1])] {
            assert!(published(&mut kept, publisher, &numbers).is_empty());
        }
        assert!(kept.appeared(ONE).is_some());
        let mut delivered = Vec::new();
        kept.started(&mut |sample| delivered.push(sample.unwrap()));
        delivered.sort_by_key(|(_, number)| *number);
        assert_eq!(delivered, [(BY_TIME, 1), (BY_TIME, 2), (OTHER, 7), (OTHER, 8)]);
        assert_eq!(answered(&mut kept, ONE, &[3, 4, 5]), (vec![3, 4, 5, 6], 0, None));
    }

    #[test]
    fn what_waits_at_a_new_start_is_not_lost() {
        let mut former = KeptSamples::new(3, true);
        assert!(former.appeared(ONE).is_some());
        for (publisher, numbers) in [(ONE, [5, 6]), (OTHER, [7, 8])] {
            assert!(published(&mut former, publisher, &numbers).is_empty());
        }
        let mut kept = KeptSamples::new(4, true);
        kept.take_over(former);
        assert!(kept.appeared(ONE).is_some());
        assert!(published(&mut kept, OTHER, &[9]).is_empty());
        let mut delivered = Vec::new();
        kept.started(&mut |sample| delivered.push(sample.unwrap()));
        assert_eq!(delivered, [(OTHER, 7), (OTHER, 8), (OTHER, 9)]);
        assert_eq!(answered(&mut kept, ONE, &[4, 5]), (vec![4, 5, 6], 0, None));
    }

    #[test]
    fn what_waits_takes_a_bounded_number_of_bytes() {
        let mut kept = kept(100);
        let request = kept.appeared(ONE).unwrap();
        assert!(published(&mut kept, ONE, &[LARGE, LARGE + 1]).is_empty());
        let all = [LARGE, LARGE + 1, LARGE + 2];
        assert_eq!(published(&mut kept, ONE, &all[2..]), all);

        let mut response = Response::default();
        for number in [1, 2, LARGE, LARGE + 1] {
            response.push(Some((ONE, number)), &request);
        }
        assert_eq!((response.samples.len(), response.dropped), (4, 0));
        response.push(Some((ONE, LARGE + 2)), &request);
        let left: Vec<u64> = response.samples.iter().map(|sample| sample.unwrap().1).collect();
        assert_eq!((left, response.dropped), (vec![LARGE + 1, LARGE + 2], 3));
        let few = Request { most: 1, ..request };
        response.push(Some((ONE, 5)), &few);
        assert_eq!((response.samples.len(), response.dropped), (1, 3), "not requested");
    }

    #[test]
    fn no_answer_and_two() {
        let mut kept = kept(3);
        assert!(kept.appeared(ONE).is_some() && kept.appeared(ONE).is_some());
        assert_eq!(kept.appeared(ONE), None, "however often it comes and goes");
        assert!(published(&mut kept, ONE, &[5]).is_empty());
        assert_eq!(answered(&mut kept, ONE, &[4]), (vec![4, 5], 0, None));
        assert_eq!(answered(&mut kept, ONE, &[]), (vec![], 0, None));
        assert_eq!(published(&mut kept, ONE, &[6]), [6]);
    }

    #[test]
    fn lost_samples_are_requested_once() {
        let mut kept = kept(4);
        assert_eq!(published(&mut kept, ONE, &[1, 2]), [1, 2]);
        let mut none = |_: Test| panic!("it waits");
        assert_eq!(from(kept.published(Some((ONE, 4)), &mut none)), 3);
        assert!(published(&mut kept, ONE, &[7]).is_empty());
        assert_eq!(answered(&mut kept, ONE, &[3, 4]), (vec![3, 4], 0, Some(5)), "a second gap");
        assert_eq!(What::From(5).parameters(), "_sn=5..");
        assert_eq!(answered(&mut kept, ONE, &[6, 7]), (vec![6, 7], 0, None), "5 is not kept any more");
        // The last one was lost.
        assert_eq!(kept.heartbeat(ONE, 7), None);
        assert_eq!(from(kept.heartbeat(ONE, 9)), 8);
        assert_eq!(kept.heartbeat(ONE, 9), None, "it is on its way");
        assert_eq!(answered(&mut kept, ONE, &[8, 9]), (vec![8, 9], 0, None));
        assert_eq!(kept.heartbeat(OTHER, 9), None, "a publisher that was never seen");
        let mut careless = KeptSamples::new(4, false);
        careless.started(&mut none);
        assert_eq!(published(&mut careless, ONE, &[1, 3]), [1, 3]);
        assert_eq!(careless.heartbeat(ONE, 9), None);
    }

    #[test]
    fn as_many_new_samples_as_are_kept_do_not_wait() {
        let mut kept = kept(3);
        assert!(kept.appeared(ONE).is_some());
        assert!(published(&mut kept, ONE, &[11, 11, 12]).is_empty());
        assert_eq!(published(&mut kept, ONE, &[13, 14]), [11, 12, 13, 14]);
        assert_eq!(answered(&mut kept, ONE, &[9, 10, 11]), (vec![], 0, None), "they have replaced these");
        assert!(kept.appeared(ONE).is_some());
        assert!(published(&mut kept, ONE, &[15]).is_empty());
        assert_eq!(answered(&mut kept, ONE, &[14, 15, 16]), (vec![15, 16], 0, None));
    }

    #[test]
    fn who_has_not_answered_is_asked_again_with_its_session() {
        let mut kept = kept(3);
        let missing = |kept: &KeptSamples<Test>, count| kept.missing(&[(ONE.0, count)].into()).len();
        let by_session = |kept: &mut KeptSamples<Test>, samples: &[(Publisher, u64)]| {
            let mut delivered = Vec::new();
            let answer = samples.iter().copied().map(Some).collect();
            let late = kept.answered_by_session(answer, &mut |sample| delivered.push(sample.unwrap()));
            delivered.sort_by_key(|(publisher, number)| (publisher.1, *number));
            (delivered, late)
        };
        assert_eq!((missing(&kept, 0), missing(&kept, 1)), (0, 1));
        assert!(kept.appeared(ONE).is_some());
        answered(&mut kept, ONE, &[]);
        assert_eq!(missing(&kept, 1), 1, "it had nothing, or was not reached");
        assert!(kept.appeared(OTHER).is_some(), "on its way");
        assert_eq!(by_session(&mut kept, &[(ONE, 2), (OTHER, 5), (ONE, 1)]), (vec![(ONE, 1), (ONE, 2)], 0));
        assert_eq!((missing(&kept, 1), missing(&kept, 2)), (0, 1));
        assert_eq!(answered(&mut kept, OTHER, &[5]), (vec![5], 0, None));
        assert_eq!(by_session(&mut kept, &[(ONE, 2), (OTHER, 5), (OTHER, 6)]), (vec![(OTHER, 6)], 0));
        assert_eq!((missing(&kept, 2), missing(&kept, 3)), (0, 1));
        by_session(&mut kept, &[(BY_TIME, 1)]);
        assert_eq!(missing(&kept, 3), 0, "who has no number answers for all of them");
        // A publisher that was heard before it was asked.
        let late = Publisher([1; 16], Some(9));
        assert_eq!(published(&mut kept, late, &[3]), [3]);
        assert_eq!(by_session(&mut kept, &[(late, 2), (late, 3)]), (vec![], 1));
    }

    #[test]
    fn a_publisher_that_has_ended_does_not_answer_for_its_successor() {
        let mut kept = kept(3);
        assert!(kept.appeared(ONE).is_some());
        answered(&mut kept, ONE, &[1]);
        kept.ended(ONE);
        assert!(kept.appeared(OTHER).is_some());
        answered(&mut kept, OTHER, &[]);
        assert_eq!(kept.missing(&[(ONE.0, 1)].into()).len(), 1);
    }

    #[test]
    fn kept_samples_that_only_a_retry_brings_are_counted_if_they_are_late() {
        let mut kept = kept(5);
        assert!(kept.appeared(ONE).is_some());
        answered(&mut kept, ONE, &[]);
        assert_eq!(published(&mut kept, ONE, &[6]), [6]);
        let answer = (2..=6).map(|number| Some((ONE, number))).collect();
        assert_eq!(kept.answered_by_session(answer, &mut |_| panic!("6 was delivered")), 4);
    }

    #[test]
    fn kept_samples_after_newer_ones_are_counted_once() {
        let mut kept = kept(3);
        assert_eq!(published(&mut kept, ONE, &[3]), [3]);
        for late in [2, 0] {
            assert!(kept.appeared(ONE).is_some());
            assert_eq!(answered(&mut kept, ONE, &[1, 2, 3]), (vec![], late, None));
        }
    }

    #[test]
    fn numbers_wrap_and_times_are_sorted() {
        let mut kept = kept(4);
        let last = u64::from(u32::MAX);
        assert!(kept.appeared(ONE).is_some() && kept.appeared(BY_TIME).is_some());
        assert!(published(&mut kept, ONE, &[0, 1]).is_empty());
        assert_eq!(answered(&mut kept, ONE, &[last - 1, last, 0]), (vec![last - 1, last, 0, 1], 0, None));
        // Of two publishers of a session.
        let times = [1 << 40, 3 << 40, 2 << 40, 4 << 40];
        assert_eq!(answered(&mut kept, BY_TIME, &times), (vec![1 << 40, 2 << 40, 3 << 40, 4 << 40], 0, None));
        // Any numbers, from a hostile peer.
        assert!(kept.appeared(OTHER).is_some());
        answered(&mut kept, OTHER, &[0, 1 << 31, 1, u64::MAX, 3 << 30, 1 << 30]);
    }

    #[test]
    fn there_is_a_most() {
        let mut kept = kept(1);
        let publisher = |n: usize| Publisher([2; 16], Some(n as u32));
        assert!((0..KeptSamples::<Test>::MOST).all(|n| kept.appeared(publisher(n)).is_some()));
        assert_eq!(kept.appeared(ONE), None);
        assert_eq!(published(&mut kept, ONE, &[2, 1]), [2, 1]);
        answered(&mut kept, publisher(0), &[]);
        assert!(kept.appeared(ONE).is_some());
    }

    #[test]
    fn tokens_of_publishers() {
        let own = ZenohId::from_str("aa").unwrap();
        let of = |key: &str| Publisher::of_token(key, own);
        let mut session = [0; 16];
        session[0] = 0xbb;
        assert_eq!(of("0/map/T/H/@adv/pub/bb/12/_"), Some(Publisher(session, Some(12))));
        assert_eq!(of("0/map/T/H/@adv/pub/bb/uhlc/_"), Some(Publisher(session, None)));
        for key in
            ["", "0/map/T/H", "m/@adv/pub/aa/12/_", "m/@adv/pub/bb", "m/@adv/pub/zz/1/_", "m/@adv/pub/bb/x/_"]
        {
            assert_eq!(of(key), None, "{key}");
        }
    }
}
