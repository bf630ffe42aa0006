//! Many short lists side by side in one allocation.
//!
//! A network has a list of vehicles per zone, and each step walks all of them in order of zone. Were each an
//! allocation of its own, the walk would wait for memory at each one's beginning; here it is one pass over
//! one array, which the processor fetches ahead of use.

use std::ops::{Index, IndexMut};

/// A fixed number of lists ("lanes") of items of one kind.
///
/// A lane that outgrows its place moves to the end of the array; when enough have moved, all are put back in
/// order. Places never shrink, so this comes to an end once every lane has seen its busiest time.
#[derive(Clone, Debug)]
pub(crate) struct Lanes<T> {
    items: Vec<T>,
    lanes: Vec<Lane>,
    /// Items in all lanes.
    total: usize,
    /// Lanes out of their place since the array was put in order.
    strays: usize,
}

#[derive(Clone, Copy, Debug, Default)]
struct Lane {
    start: u32,
    len: u32,
    capacity: u32,
}

impl Lane {
    fn range(self) -> std::ops::Range<usize> {
        self.start as usize..(self.start + self.len) as usize
    }
}

/// How many lanes ahead to fetch: some hundred nanoseconds of work, which is how far memory is away.
pub(crate) const AHEAD: usize = 6;

/// Has the processor fetch items that will soon be read, without waiting for them.
#[inline]
pub(crate) fn fetch<T>(items: &[T]) {
    const LINE: usize = 64;
    #[cfg(target_arch = "x86_64")]
    for offset in (0..size_of_val(items)).step_by(LINE) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a prefetch is a hint and never faults, whatever the address; SSE is part of x86-64.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(items.as_ptr().cast::<i8>().wrapping_add(offset)) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (items, LINE);
}

/// Room of a lane's first place.
const FIRST_CAPACITY: u32 = 4;

impl<T: Copy> Lanes<T> {
    /// That many empty lanes.
    pub fn new(count: usize) -> Lanes<T> {
        Lanes { items: Vec::new(), lanes: vec![Lane::default(); count], total: 0, strays: 0 }
    }

    /// Items in all lanes.
    pub fn total(&self) -> usize {
        self.total
    }

    /// Has the processor fetch a lane that will soon be walked; does nothing past the last.
    #[inline]
    pub fn fetch(&self, lane: usize) {
        if let Some(lane) = self.lanes.get(lane) {
            fetch(&self.items[lane.range()]);
        }
    }

    /// Appends an item to a lane.
    pub fn push(&mut self, lane: usize, item: T) {
        let Lane { len, capacity, .. } = self.lanes[lane];
        if len == capacity {
            self.make_room(lane, (len + len / 2 + 1).max(FIRST_CAPACITY), item);
        }
        let place = &mut self.lanes[lane];
        self.items[(place.start + place.len) as usize] = item;
        place.len += 1;
        self.total += 1;
    }

    /// Drops what is in a lane from `len` on.
    pub fn truncate(&mut self, lane: usize, len: usize) {
        let place = &mut self.lanes[lane];
        let len = (len as u32).min(place.len);
        self.total -= (place.len - len) as usize;
        place.len = len;
    }

    /// Replaces a lane's items.
    pub fn set(&mut self, lane: usize, items: &[T]) {
        let len = items.len() as u32;
        if let (true, Some(&filler)) = (len > self.lanes[lane].capacity, items.first()) {
            self.truncate(lane, 0);
            self.make_room(lane, (len + len / 2).max(FIRST_CAPACITY), filler);
        }
        let place = &mut self.lanes[lane];
        self.total = self.total + items.len() - place.len as usize;
        place.len = len;
        self.items[place.range()].copy_from_slice(items);
    }

    /// Moves a lane to a larger place; `filler` stands where nothing is yet.
    fn make_room(&mut self, lane: usize, capacity: u32, filler: T) {
        let old = self.lanes[lane];
        let start = self.items.len();
        self.items.extend_from_within(old.range());
        self.items.resize(start + capacity as usize, filler);
        let start = u32::try_from(start).expect("fewer than 2^32 vehicles have places in a network");
        self.lanes[lane] = Lane { start, len: old.len, capacity };
        self.strays += 1;
        if self.strays > self.lanes.len() / 8 {
            self.put_in_order(filler);
        }
    }

    fn put_in_order(&mut self, filler: T) {
        let size: usize = self.lanes.iter().map(|lane| lane.capacity as usize).sum();
        let mut items = Vec::with_capacity(size + size / 8);
        for lane in &mut self.lanes {
            let start = items.len();
            items.extend_from_slice(&self.items[lane.range()]);
            items.resize(start + lane.capacity as usize, filler);
            lane.start = start as u32;
        }
        self.items = items;
        self.strays = 0;
    }
}

impl<T> Index<usize> for Lanes<T> {
    type Output = [T];

    fn index(&self, lane: usize) -> &[T] {
        &self.items[self.lanes[lane].range()]
    }
}

impl<T> IndexMut<usize> for Lanes<T> {
    fn index_mut(&mut self, lane: usize) -> &mut [T] {
        &mut self.items[self.lanes[lane].range()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[derive(Clone, Debug)]
    enum Change {
        Push(usize, u32),
        Truncate(usize, usize),
        Set(usize, Vec<u32>),
    }

    fn change() -> impl Strategy<Value = Change> {
        prop_oneof![
            4 => (0..20usize, any::<u32>()).prop_map(|(lane, item)| Change::Push(lane, item)),
            1 => (0..20usize, 0..6usize).prop_map(|(lane, len)| Change::Truncate(lane, len)),
            1 => (0..20usize, prop::collection::vec(any::<u32>(), 0..12)).prop_map(|(l, v)| Change::Set(l, v)),
        ]
    }

    proptest! {
        #[test]
        fn lanes_are_as_many_vectors(changes in prop::collection::vec(change(), 0..400)) {
            let (mut lanes, mut vectors) = (Lanes::new(20), vec![Vec::new(); 20]);
            for change in changes {
                match change {
                    Change::Push(lane, item) => {
                        lanes.push(lane, item);
                        vectors[lane].push(item);
                    }
                    Change::Truncate(lane, len) => {
                        lanes.truncate(lane, len);
                        vectors[lane].truncate(len);
                    }
                    Change::Set(lane, items) => {
                        lanes.set(lane, &items);
                        vectors[lane] = items;
                    }
                }
                prop_assert_eq!(lanes.total(), vectors.iter().map(Vec::len).sum::<usize>());
            }
            for (i, vector) in vectors.iter().enumerate() {
                prop_assert_eq!(&lanes[i], &vector[..]);
            }
        }
    }
}
