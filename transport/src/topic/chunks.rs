// SPDX-License-Identifier: MIT OR Apache-2.0
//! A sorted list that is cheap to copy: it consists of chunks that copies share, and a change replaces only one chunk. So setup code
//! can hand over a list of a thousand endpoints again and again, even if only one of them has changed.

use crate::memory::header::Gid;
use std::sync::Arc;

/// The maximum number of elements in a chunk.
const FULL: usize = 32;

pub(crate) trait Keyed: Clone {
    /// The element's key, unique within a list.
    fn key(&self) -> Gid;
}

/// A list in the order of the keys, so that the elements of one participant are next to each other.
#[derive(Clone)]
pub(crate) struct Chunks<T> {
    chunks: Vec<Arc<Vec<T>>>,
    len: usize,
}

impl<T> Default for Chunks<T> {
    fn default() -> Self {
        Chunks { chunks: Vec::new(), len: 0 }
    }
}

impl<T> Chunks<T> {
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = &T> {
        self.chunks.iter().flat_map(|chunk| chunk.iter())
    }

    /// All elements, each with its position: beginning with the one at `first` if there is one, then those before it.
    ///
    /// # Real-time
    /// O(elements); no allocation; no syscall.
    pub(crate) fn iter_from(&self, first: usize) -> impl Iterator<Item = (usize, &T)> {
        let first = if first < self.len { first } else { 0 };
        let (mut chunk, mut skipped) = (0, 0);
        while let Some(passed) = self.chunks.get(chunk).filter(|passed| skipped + passed.len() <= first) {
            skipped += passed.len();
            chunk += 1;
        }
        let (before, after) = self.chunks.split_at(chunk);
        let places = (skipped..self.len).chain(0..self.len);
        let from_chunk = after.iter().chain(before).chain(after.first());
        let elements = from_chunk.flat_map(|chunk| chunk.iter());
        places.zip(elements).skip(first - skipped).take(self.len)
    }
}

impl<T: Keyed> Chunks<T> {
    /// The index of the chunk that contains this key, or would contain it, and the key's position in the chunk.
    fn find(&self, key: Gid) -> (usize, Result<usize, usize>) {
        let is_before = |chunk: &Arc<Vec<T>>| chunk.last().is_some_and(|last| last.key() < key);
        let chunk = self.chunks.partition_point(is_before).min(self.chunks.len().saturating_sub(1));
        let place = self.chunks.get(chunk).map_or(Err(0), |chunk| chunk.binary_search_by_key(&key, T::key));
        (chunk, place)
    }

    pub(crate) fn get(&self, key: Gid) -> Option<&T> {
        let (chunk, place) = self.find(key);
        self.chunks.get(chunk)?.get(place.ok()?)
    }

    /// The element with this key, to be changed. Copies of the list keep the former element.
    pub(crate) fn get_mut(&mut self, key: Gid) -> Option<&mut T> {
        let (chunk, place) = self.find(key);
        Arc::make_mut(self.chunks.get_mut(chunk)?).get_mut(place.ok()?)
    }

    /// Adds an element, or replaces the one with the same key.
    pub(crate) fn insert(&mut self, element: T) {
        let (chunk, place) = self.find(element.key());
        let Some(into) = self.chunks.get_mut(chunk) else {
            self.chunks.push(Arc::new(vec![element]));
            self.len += 1;
            return;
        };
        let elements = Arc::make_mut(into);
        match place {
            Ok(place) => elements[place] = element,
            Err(place) => {
                elements.insert(place, element);
                self.len += 1;
                if elements.len() > FULL {
                    // A list that grows at its end keeps its chunks full.
                    let rest = elements.split_off(if place == FULL { FULL } else { FULL / 2 });
                    self.chunks.insert(chunk + 1, Arc::new(rest));
                }
            }
        }
    }

    pub(crate) fn remove(&mut self, key: Gid) -> Option<T> {
        let (chunk, place) = self.find(key);
        let elements = Arc::make_mut(self.chunks.get_mut(chunk)?);
        let removed = elements.remove(place.ok()?);
        self.len -= 1;
        if elements.is_empty() {
            self.chunks.remove(chunk);
        }
        Some(removed)
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use rand::RngExt;
    use std::collections::BTreeMap;

    #[derive(Clone, Debug, PartialEq)]
    struct Element(Gid, u32);

    impl Keyed for Element {
        fn key(&self) -> Gid {
            self.0
        }
    }

    #[test]
    fn as_a_map_and_copies_stay_as_they_are() {
        let mut random = tautline_seed::random();
        let (mut chunks, mut map) = (Chunks::<Element>::default(), BTreeMap::new());
        let mut copies = Vec::new();
        for n in 0..5000 {
            let key = Gid::of(random.random_range(0..20), random.random_range(0..20));
            match random.random_range(0..4) {
                0 => assert_eq!(chunks.remove(key).map(|element| element.1), map.remove(&key)),
                1 => {
                    let changed = chunks.get_mut(key).map(|element| element.1 = n).is_some();
                    assert_eq!(changed, map.get_mut(&key).map(|value| *value = n).is_some());
                }
                _ => {
                    chunks.insert(Element(key, n));
                    map.insert(key, n);
                }
            }
            assert_eq!(chunks.get(key).map(|element| element.1), map.get(&key).copied());
            assert_eq!(chunks.len(), map.len());
            if n % 100 == 0 {
                copies.push((chunks.clone(), map.clone()));
            }
        }
        for (chunks, map) in copies {
            let listed: Vec<_> = chunks.iter().map(|element| (element.0, element.1)).collect();
            assert_eq!(listed, map.into_iter().collect::<Vec<_>>());
            assert!(chunks.chunks.iter().all(|chunk| (1..=FULL).contains(&chunk.len())));
            for first in 0..chunks.len() + 2 {
                let turned: Vec<_> =
                    chunks.iter_from(first).map(|(place, element)| (place, element.1)).collect();
                let first = if first < chunks.len() { first } else { 0 };
                let places = (first..chunks.len()).chain(0..first);
                assert_eq!(
                    turned,
                    places.map(|place| (place, listed[place].1)).collect::<Vec<_>>(),
                    "{first}"
                );
            }
        }
    }
}
