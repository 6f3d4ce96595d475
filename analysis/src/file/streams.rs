// SPDX-License-Identifier: MIT OR Apache-2.0
//! The streams of messages that reach each callback.
use super::graph::Graph;
use super::problem::Collector;
use std::ops::Range;

/// A callback is analysed once for each way that messages reach it; more ways than this are refused.
const MAX_STREAMS: usize = 64;

/// One way that releases reach a callback.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Source {
    Period,
    /// A topic whose publisher is not in the file, by index.
    Outside(usize),
    /// A stream of another callback: the callback, and which of its streams.
    Stream(usize, usize),
    /// All that the callback waits for.
    All,
}

/// The streams of releases that reach a callback, by callback.
pub(super) struct Streams {
    sources: Vec<Vec<Source>>,
    /// The topics by which each of these sources reaches it; unused for a period.
    topics: Vec<Vec<usize>>,
    /// Whether the callback waits for all of them.
    joins: Vec<bool>,
    first: Vec<usize>,
}

/// The first source of a stream of releases.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum First {
    Callback(usize),
    /// A topic whose publisher is not in the file.
    Topic(usize),
    /// A callback that waits for several.
    Join(usize),
}

impl Streams {
    /// The sources whose releases reach a callback.
    pub fn sources(&self, callback: usize) -> &[Source] {
        &self.sources[callback]
    }

    /// The topic of the callback by which each of its sources reaches it.
    pub fn topics(&self, callback: usize) -> &[usize] {
        &self.topics[callback]
    }

    pub fn is_join(&self, callback: usize) -> bool {
        self.joins[callback]
    }

    /// Its tasks: one for each stream. A join has one more, in front: the task that runs when all messages
    /// are there.
    pub fn tasks(&self, callback: usize) -> Range<usize> {
        let first = self.first[callback];
        first..first + self.sources[callback].len() + usize::from(self.joins[callback])
    }

    /// The first source of the chain of triggers that reaches `callback` by `source`. A join begins a new chain.
    pub fn first(&self, mut callback: usize, mut source: Source) -> First {
        loop {
            match source {
                Source::Period => return First::Callback(callback),
                Source::Outside(topic) => return First::Topic(topic),
                Source::All => return First::Join(callback),
                Source::Stream(publisher, _) if self.joins[publisher] => return First::Join(publisher),
                Source::Stream(publisher, stream) => {
                    (callback, source) = (publisher, self.sources[publisher][stream]);
                }
            }
        }
    }

    /// The tasks that publish, one for each stream that leaves it.
    pub fn outputs(&self, callback: usize) -> Range<usize> {
        let tasks = self.tasks(callback);
        if self.joins[callback] { tasks.start..tasks.start + 1 } else { tasks }
    }
}

impl Graph<'_> {
    /// The streams of releases of every callback, and the places of their tasks; call it on a graph without problems.
    pub fn streams(&self, problems: &Collector) -> Streams {
        let (sources, topics): (Vec<_>, Vec<_>) = self
            .sources(problems)
            .into_iter()
            .map(|streams| streams.into_iter().unzip::<_, _, Vec<_>, Vec<_>>())
            .unzip();
        let joins: Vec<bool> = self.file.callbacks.iter().map(|callback| callback.all.is_some()).collect();
        let mut first = Vec::with_capacity(sources.len());
        let mut next = 0;
        for (streams, is_join) in sources.iter().zip(&joins) {
            first.push(next);
            next += streams.len() + usize::from(*is_join);
        }
        Streams { sources, topics, joins, first }
    }

    /// The sources of every callback, each with the topic by which it comes.
    fn sources(&self, problems: &Collector) -> Vec<Vec<(Source, usize)>> {
        let mut streams: Vec<Vec<(Source, usize)>> = vec![Vec::new(); self.file.callbacks.len()];
        let triggered = self.triggered();
        let mut missing: Vec<usize> = (0..streams.len()).map(|i| self.triggers(i).count()).collect();
        let mut ready: Vec<usize> = (0..streams.len()).filter(|i| missing[*i] == 0).collect();
        while let Some(i) = ready.pop() {
            streams[i] = self.streams_of(i, &streams);
            if streams[i].len() > MAX_STREAMS {
                let callback = &self.file.callbacks[i];
                problems.at(callback.at).add(format!(
                    "callback `{}` is reached in more than {MAX_STREAMS} ways: let a callback on the way run by \
                     `period`",
                    callback.name
                ));
                return streams;
            }
            for &to in &triggered[i] {
                missing[to] -= 1;
                if missing[to] == 0 {
                    ready.push(to);
                }
            }
        }
        streams
    }

    fn streams_of(&self, index: usize, streams: &[Vec<(Source, usize)>]) -> Vec<(Source, usize)> {
        let callback = &self.file.callbacks[index];
        if callback.period.is_some() {
            return vec![(Source::Period, 0)];
        }
        let outputs = |p: usize| if self.file.callbacks[p].all.is_some() { 1 } else { streams[p].len() };
        let mut sources = Vec::new();
        for (at, topic) in callback.topics.iter().enumerate() {
            let name = topic.value.as_str();
            match self.publishers.get(name) {
                Some(publishers) => {
                    let all = publishers.iter().flat_map(|p| (0..outputs(*p)).map(|s| Source::Stream(*p, s)));
                    sources.extend(all.map(|source| (source, at)));
                }
                None => {
                    let topic = self
                        .declared
                        .get(name)
                        .and_then(|topic| self.file.topics.iter().position(|t| std::ptr::eq(t, *topic)));
                    sources.extend(topic.map(|topic| (Source::Outside(topic), at)));
                }
            }
        }
        sources
    }
}
