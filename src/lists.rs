//! Many short lists side by side in one allocation.
//!
//! A network has a list of vehicles per zone, and each step walks all of them in order of zone. Were each an
//! allocation of its own, the walk would wait for memory at each one's beginning; here it is one pass over
//! one array, which the processor fetches ahead of use.

use std::ops::{Index, IndexMut};

/// A fixed number of lists of items of one kind.
///
/// A list that outgrows its place moves to the end of the array; when enough have moved, all are put back in
/// order. Places never shrink, so this comes to an end once every list has seen its busiest time.
#[derive(Clone, Debug)]
pub(crate) struct Lists<T> {
    items: Vec<T>,
    lists: Vec<List>,
    /// Items in all lists.
    total: usize,
    /// Lists out of their place since the array was put in order.
    strays: usize,
}

#[derive(Clone, Copy, Debug, Default)]
struct List {
    start: u32,
    len: u32,
    capacity: u32,
}

impl List {
    fn range(self) -> std::ops::Range<usize> {
        self.start as usize..(self.start + self.len) as usize
    }
}

/// How many lists ahead to fetch: some hundred nanoseconds of work, which is how far memory is away.
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

/// Room of a list's first place.
const FIRST_CAPACITY: u32 = 4;

impl<T: Copy> Lists<T> {
    /// That many empty lists.
    pub fn new(count: usize) -> Lists<T> {
        Lists { items: Vec::new(), lists: vec![List::default(); count], total: 0, strays: 0 }
    }

    /// Items in all lists.
    pub fn total(&self) -> usize {
        self.total
    }

    /// Has the processor fetch a list that will soon be walked; does nothing past the last.
    #[inline]
    pub fn fetch(&self, list: usize) {
        if let Some(list) = self.lists.get(list) {
            fetch(&self.items[list.range()]);
        }
    }

    /// Appends an item to a list.
    pub fn push(&mut self, list: usize, item: T) {
        let List { len, capacity, .. } = self.lists[list];
        if len == capacity {
            self.make_room(list, (len + len / 2 + 1).max(FIRST_CAPACITY), item);
        }
        let place = &mut self.lists[list];
        self.items[(place.start + place.len) as usize] = item;
        place.len += 1;
        self.total += 1;
    }

    /// Drops what is in a list from `len` on.
    pub fn truncate(&mut self, list: usize, len: usize) {
        let place = &mut self.lists[list];
        let len = (len as u32).min(place.len);
        self.total -= (place.len - len) as usize;
        place.len = len;
    }

    /// Replaces a list's items.
    pub fn set(&mut self, list: usize, items: &[T]) {
        let len = items.len() as u32;
        if let (true, Some(&filler)) = (len > self.lists[list].capacity, items.first()) {
            self.truncate(list, 0);
            self.make_room(list, (len + len / 2).max(FIRST_CAPACITY), filler);
        }
        let place = &mut self.lists[list];
        self.total = self.total + items.len() - place.len as usize;
        place.len = len;
        self.items[place.range()].copy_from_slice(items);
    }

    /// Moves a list to a larger place; `filler` stands where nothing is yet.
    fn make_room(&mut self, list: usize, capacity: u32, filler: T) {
        let old = self.lists[list];
        let start = self.items.len();
        self.items.extend_from_within(old.range());
        self.items.resize(start + capacity as usize, filler);
        let start = u32::try_from(start).expect("fewer than 2^32 vehicles have places in a network");
        self.lists[list] = List { start, len: old.len, capacity };
        self.strays += 1;
        if self.strays > self.lists.len() / 8 {
            self.put_in_order(filler);
        }
    }

    fn put_in_order(&mut self, filler: T) {
        let size: usize = self.lists.iter().map(|list| list.capacity as usize).sum();
        let mut items = Vec::with_capacity(size + size / 8);
        for list in &mut self.lists {
            let start = items.len();
            items.extend_from_slice(&self.items[list.range()]);
            items.resize(start + list.capacity as usize, filler);
            list.start = start as u32;
        }
        self.items = items;
        self.strays = 0;
    }
}

impl<T> Index<usize> for Lists<T> {
    type Output = [T];

    fn index(&self, list: usize) -> &[T] {
        &self.items[self.lists[list].range()]
    }
}

impl<T> IndexMut<usize> for Lists<T> {
    fn index_mut(&mut self, list: usize) -> &mut [T] {
        &mut self.items[self.lists[list].range()]
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
            4 => (0..20usize, any::<u32>()).prop_map(|(list, item)| Change::Push(list, item)),
            1 => (0..20usize, 0..6usize).prop_map(|(list, len)| Change::Truncate(list, len)),
            1 => (0..20usize, prop::collection::vec(any::<u32>(), 0..12)).prop_map(|(l, v)| Change::Set(l, v)),
        ]
    }

    proptest! {
        #[test]
        fn lanes_are_as_many_vectors(changes in prop::collection::vec(change(), 0..400)) {
            let (mut lists, mut vectors) = (Lists::new(20), vec![Vec::new(); 20]);
            for change in changes {
                match change {
                    Change::Push(list, item) => {
                        lists.push(list, item);
                        vectors[list].push(item);
                    }
                    Change::Truncate(list, len) => {
                        lists.truncate(list, len);
                        vectors[list].truncate(len);
                    }
                    Change::Set(list, items) => {
                        lists.set(list, &items);
                        vectors[list] = items;
                    }
                }
                prop_assert_eq!(lists.total(), vectors.iter().map(Vec::len).sum::<usize>());
            }
            for (i, vector) in vectors.iter().enumerate() {
                prop_assert_eq!(&lists[i], &vector[..]);
            }
        }
    }
}
