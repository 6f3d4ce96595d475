// SPDX-License-Identifier: MIT OR Apache-2.0
//! The streams of messages that reach each callback.
use super::graph::Graph;
use super::problem::Collector;

/// A callback is analysed once for each way that messages reach it; more ways than this are refused.
const MAX_STREAMS: usize = 64;

/// One way that releases reach a callback.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Source {
    /// Its own period.
    Period,
    /// A topic whose publisher is not in the file, by index.
    Outside(usize),
    /// A stream of another callback: the callback, and which of its streams.
    Stream(usize, usize),
}

impl Graph<'_> {
    /// The streams of releases of every callback; call it on a graph without problems.
    pub fn streams(&self, problems: &mut Collector) -> Vec<Vec<Source>> {
        let mut streams: Vec<Vec<Source>> = vec![Vec::new(); self.file.callbacks.len()];
        let mut waiting: Vec<usize> = (0..streams.len()).collect();
        while !waiting.is_empty() {
            let ready = |i: &usize| self.triggers(*i).all(|source| !streams[source].is_empty());
            let (now, later): (Vec<_>, Vec<_>) = waiting.iter().copied().partition(ready);
            if now.is_empty() {
                return streams;
            }
            for i in now {
                streams[i] = self.streams_of(i, &streams);
                if streams[i].len() > MAX_STREAMS {
                    let callback = &self.file.callbacks[i];
                    problems.add(
                        callback.at,
                        format!(
                            "callback `{}` is reached in more than {MAX_STREAMS} \
                         ways: let a callback on the way run by `period`",
                            callback.name
                        ),
                    );
                    return streams;
                }
            }
            waiting = later;
        }
        streams
    }

    fn streams_of(&self, index: usize, streams: &[Vec<Source>]) -> Vec<Source> {
        let callback = &self.file.callbacks[index];
        if callback.period.is_some() {
            return vec![Source::Period];
        }
        let mut sources = Vec::new();
        for topic in &callback.topics {
            let name = topic.value.as_str();
            match self.publishers.get(name) {
                Some(publishers) => {
                    let all =
                        publishers.iter().flat_map(|p| (0..streams[*p].len()).map(|s| Source::Stream(*p, s)));
                    sources.extend(all);
                }
                None => {
                    sources.extend(self.file.topics.iter().position(|t| t.name == name).map(Source::Outside))
                }
            }
        }
        sources
    }
}
