// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which callback triggers which: topics, their publishers, and the streams of messages that reach each
//! callback.
use std::collections::{HashMap, HashSet};

use super::content::JoinPolicy;
use super::declared::{Callback, Declared, Topic};
use super::places::Place;
use super::problem::Collector;
use super::reader::At;

/// Most topics that a callback waits for, as in message_filters.
const MOST_INPUTS: usize = 9;

/// Topics by name.
pub(super) struct Graph<'f> {
    pub file: &'f Declared,
    pub publishers: HashMap<&'f str, Vec<usize>>,
    pub declared: HashMap<&'f str, &'f Topic>,
}

impl<'f> Graph<'f> {
    pub fn new(file: &'f Declared) -> Self {
        let mut publishers: HashMap<_, Vec<usize>> = HashMap::new();
        for (i, callback) in file.callbacks.iter().enumerate() {
            for topic in &callback.publishes {
                publishers.entry(topic.value.as_str()).or_default().push(i);
            }
        }
        let declared = file.topics.iter().map(|topic| (topic.name.as_str(), topic)).collect();
        Self { file, publishers, declared }
    }

    /// Checks triggers, reads and topics, and that nothing triggers itself.
    pub fn check(&self, places: &[Option<Place>], problems: &Collector) {
        let shortest = self.shortest_periods();
        for (i, callback) in self.file.callbacks.iter().enumerate() {
            self.check_trigger(callback, problems);
            check_lists(callback, problems);
            self.check_join(callback, problems);
            for topic in callback.topics.iter().chain(&callback.reads) {
                self.check_topic(callback, topic.at, &topic.value, problems);
                self.check_way(i, topic.at, &topic.value, places, problems);
            }
            self.check_times(i, shortest[i], problems);
        }
        for topic in &self.file.topics {
            if let (Some(period), true) = (&topic.period, self.publishers.contains_key(topic.name.as_str())) {
                problems.at(period.at).add(format!(
                    "topic `{}` has a `period` and a publisher in the file: remove the period",
                    topic.name
                ));
            }
            if let (Some(distance), Some(period)) = (&topic.min_distance, &topic.period)
                && distance.value > period.value
            {
                problems
                    .at(distance.at)
                    .add(format!("`min_distance` of topic `{}` exceeds its period: lower it", topic.name));
            }
        }
        self.check_circles(problems);
    }

    fn check_trigger(&self, callback: &Callback, problems: &Collector) {
        let name = &callback.name;
        if !callback.triggered {
            problems
                .at(callback.at)
                .add(format!("callback `{name}` has no trigger: add `topic`, `all` or `period`"));
        } else if let (Some(period), Some(_)) = (&callback.period, callback.topics.first()) {
            problems.at(period.at).add(format!(
                "callback `{name}` has two triggers, `{}` and `period`: remove one, or list the topic in `reads`",
                if callback.all.is_some() { "all" } else { "topic" }
            ));
        }
        if callback.period.is_none() {
            for (key, value) in [("jitter", &callback.jitter), ("min_distance", &callback.min_distance)] {
                if let (Some(value), true) = (value, callback.triggered) {
                    problems.at(value.at).add(format!(
                        "`{key}` of callback `{name}` needs a `period`: a topic's is stated in [topics], or computed"
                    ));
                }
            }
        }
    }

    /// Checks what a callback waits for: several topics; only then it may have a window.
    fn check_join(&self, callback: &Callback, problems: &Collector) {
        let name = &callback.name;
        let Some(all) = callback.all else {
            let at = |time: &Option<At<u64>>| time.as_ref().map(|time| time.at);
            let policy = callback.policy.as_ref().map(|policy| policy.at);
            for (key, at) in
                [("window", at(&callback.window)), ("take", at(&callback.take)), ("policy", policy)]
            {
                if let Some(at) = at {
                    problems.at(at).add(format!(
                        "`{key}` of callback `{name}` is without `all`: list the topics that it waits for there"
                    ));
                }
            }
            return;
        };
        if callback.has_topic {
            problems.at(all).add(format!(
                "callback `{name}` has two triggers, `topic` and `all`: put the topics that it waits for together into \
                 `all`, and the others into another callback, or into `reads`"
            ));
            return;
        }
        if !(2..=MOST_INPUTS).contains(&callback.topics.len()) {
            problems.at(all).add(format!(
                "callback `{name}` waits for {} topic(s) in `all`: list 2 to {MOST_INPUTS}, or use `topic` for one",
                callback.topics.len()
            ));
        }
        match (&callback.policy, &callback.window) {
            (Some(At { value: JoinPolicy::LatestTime, at }), Some(_)) => problems.at(*at).add(format!(
                "callback `{name}` has `policy = \"latest_time\"`, which does not look at stamps, and a `window`: \
                 leave out one of them"
            )),
            (Some(At { value: JoinPolicy::ApproximateEpsilonTime, at }), window)
                if window.as_ref().is_none_or(|window| window.value == 0) =>
            {
                problems.at(*at).add(format!(
                    "callback `{name}` has `policy = \"approximate_epsilon_time\"`: set its `window` to how far apart \
                     the stamps of a set may lie, above 0; for equal stamps leave out the policy"
                ));
            }
            _ => {}
        }
        if let (Some(take), Some(wcet)) = (&callback.take, &callback.wcet)
            && take.value > wcet.value
        {
            problems.at(take.at).add(format!(
                "`take` of callback `{name}` exceeds its wcet, of which it is a part: lower it"
            ));
        }
    }

    fn check_topic(&self, callback: &Callback, at: usize, topic: &str, problems: &Collector) {
        if self.publishers.contains_key(topic) {
            return;
        }
        match self.declared.get(topic) {
            Some(declared) if declared.period.is_some() => {}
            Some(_) => problems.at(at).add(format!(
                "topic `{topic}`, used by callback `{}`, has no publisher: add it to the `publishes` of one, or give \
                 the topic a `period` if its publisher is not in the file",
                callback.name
            )),
            None => {
                let known = self.publishers.keys().chain(self.declared.keys()).copied();
                let hint = problems.suggestion(topic, known);
                let fix = if hint.is_empty() {
                    ": declare it in [topics], or let a callback publish \
                     it"
                    .into()
                } else {
                    hint
                };
                problems.at(at).add(format!(
                    "callback `{}` uses topic `{topic}`, which does not exist{fix}",
                    callback.name
                ));
            }
        }
    }

    /// Checks that a message between hosts has a remote topic and a network.
    fn check_way(
        &self,
        callback: usize,
        at: usize,
        topic: &str,
        places: &[Option<Place>],
        problems: &Collector,
    ) {
        let Some(here) = places[callback] else { return };
        for &publisher in self.publishers.get(topic).into_iter().flatten() {
            let Some(there) = places[publisher].filter(|there| there.host != here.host) else { continue };
            let (from, to) = (&self.file.hosts[there.host].name, &self.file.hosts[here.host].name);
            if !self.declared.get(topic).is_some_and(|topic| topic.remote) {
                problems.at(at).add(format!(
                    "topic `{topic}` goes from host `{from}` to `{to}` but is not remote: add `remote = true` to it in \
                     [topics]"
                ));
            }
            if self.file.network.is_none() {
                problems.at(at).add(format!(
                    "topic `{topic}` goes from host `{from}` to `{to}`: add `latency = [shortest, longest]` to \
                     [network]"
                ));
            }
        }
    }

    fn check_times(&self, index: usize, period: Option<u64>, problems: &Collector) {
        let callback = &self.file.callbacks[index];
        let name = &callback.name;
        let limits = [
            ("wcet", &callback.wcet, "period", period),
            ("min_distance", &callback.min_distance, "period", period),
            ("bcet", &callback.bcet, "wcet", callback.wcet.as_ref().map(|wcet| wcet.value)),
            (
                "non_preemptive",
                &callback.non_preemptive,
                "wcet",
                callback.wcet.as_ref().map(|wcet| wcet.value),
            ),
        ];
        for (key, part, whole_key, whole) in limits {
            if let (Some(part), Some(whole)) = (part, whole)
                && part.value > whole
            {
                let (value, whole) = (part.value as f64 / 1e6, whole as f64 / 1e6);
                problems.at(part.at).add(format!(
                    "`{key}` of callback `{name}` is {value} ms, more than its {whole_key} of {whole} ms: lower it, or \
                     raise the {whole_key}"
                ));
            }
        }
        for (resource, length) in &callback.locks {
            if let Some(wcet) = callback.wcet.as_ref().filter(|wcet| *length > wcet.value) {
                let (length, wcet) = (*length as f64 / 1e6, wcet.value as f64 / 1e6);
                problems.at(callback.at).add(format!(
                    "callback `{name}` holds lock `{resource}` for {length} ms, longer than its wcet of {wcet} ms, of which that is a part: \
                     lower its `length`, or raise the wcet"
                ));
            }
        }
    }

    /// The shortest period of what triggers each callback, if it is known. A join waits for the slowest of its topics, unless it runs at the
    /// pace of the fastest.
    fn shortest_periods(&self) -> Vec<Option<u64>> {
        let callbacks = &self.file.callbacks;
        let publishes = |i: usize| callbacks[i].publishes.iter().map(|topic| topic.value.as_str());
        let mut shortest = vec![None; callbacks.len()];
        let mut takers: HashMap<&str, Vec<usize>> = HashMap::new();
        // Each source's period, and the topics that have it.
        let mut sources: Vec<(u64, Vec<&str>)> = Vec::new();
        for (i, callback) in callbacks.iter().enumerate() {
            if let Some(period) = &callback.period {
                shortest[i] = Some(period.value);
                sources.push((period.value, publishes(i).collect()));
                continue;
            }
            callback.topics.iter().for_each(|topic| takers.entry(topic.value.as_str()).or_default().push(i));
        }
        let outside = |topic: &'f Topic| Some((topic.period.as_ref()?.value, vec![topic.name.as_str()]));
        sources.extend(self.file.topics.iter().filter_map(outside));
        // The shortest first: a callback that is reached has this period, and so have all that it triggers.
        sources.sort_unstable();
        let waits_for_all =
            |callback: &Callback| callback.all.is_some() && callback.policy() != JoinPolicy::LatestTime;
        let waits_for = |callback: &Callback| if waits_for_all(callback) { callback.topics.len() } else { 1 };
        let mut missing: Vec<usize> = callbacks.iter().map(waits_for).collect();
        let mut seen = HashSet::new();
        for (period, mut next) in sources {
            while let Some(topic) = next.pop() {
                if !seen.insert(topic) {
                    continue;
                }
                for &i in takers.get(topic).into_iter().flatten() {
                    missing[i] = missing[i].saturating_sub(1);
                    if missing[i] == 0 && shortest[i].is_none() {
                        shortest[i] = Some(period);
                        next.extend(publishes(i));
                    }
                }
            }
        }
        shortest
    }

    /// The callbacks that each triggers, once for each topic.
    pub fn triggered(&self) -> Vec<Vec<usize>> {
        let mut triggered = vec![Vec::new(); self.file.callbacks.len()];
        for to in 0..triggered.len() {
            self.triggers(to).for_each(|from| triggered[from].push(to));
        }
        triggered
    }

    /// The callbacks whose messages trigger a callback.
    pub fn triggers(&self, index: usize) -> impl Iterator<Item = usize> {
        let topics = self.file.callbacks[index].topics.iter();
        topics.flat_map(|topic| self.publishers.get(topic.value.as_str()).into_iter().flatten().copied())
    }

    fn check_circles(&self, problems: &Collector) {
        // 0: not seen, 1: on the path, 2: done.
        let mut state = vec![0; self.file.callbacks.len()];
        for start in 0..state.len() {
            let mut path = vec![(start, self.triggers(start).collect::<Vec<_>>())];
            if state[start] != 0 {
                continue;
            }
            state[start] = 1;
            while let Some((i, next)) = path.last_mut() {
                let i = *i;
                match next.pop() {
                    None => {
                        state[i] = 2;
                        path.pop();
                    }
                    Some(j) if state[j] == 1 => {
                        let from = path.iter().position(|(seen, _)| *seen == j).unwrap_or(0);
                        let names = path[from..]
                            .iter()
                            .rev()
                            .map(|(i, _)| format!("`{}`", self.file.callbacks[*i].name));
                        let names = names.collect::<Vec<_>>().join(", ");
                        problems.at(self.file.callbacks[j].at).add(format!(
                            "callbacks {names} trigger one another in a circle: let one of them run by `period` and \
                             list the topic in its `reads`"
                        ));
                    }
                    Some(j) if state[j] == 0 => {
                        state[j] = 1;
                        path.push((j, self.triggers(j).collect()));
                    }
                    Some(_) => {}
                }
            }
        }
    }
}

/// Checks that a callback lists each topic once: its messages would count twice.
fn check_lists(callback: &Callback, problems: &Collector) {
    let trigger = if callback.all.is_some() { "all" } else { "topic" };
    for (key, topics) in
        [(trigger, &callback.topics), ("publishes", &callback.publishes), ("reads", &callback.reads)]
    {
        let mut seen = HashSet::new();
        for topic in topics.iter().filter(|topic| !seen.insert(topic.value.as_str())) {
            let (name, topic, at) = (&callback.name, &topic.value, topic.at);
            problems
                .at(at)
                .add(format!("`{key}` of callback `{name}` lists topic `{topic}` twice: list it once"));
        }
    }
}
