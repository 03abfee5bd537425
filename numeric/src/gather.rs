//! States in lanes, gathered from one state per lane.

use nalgebra::SimdValue;

/// Iterate over one instance per lane; surplus lanes repeat the last one.
pub fn padded<T>(of: &[T], lanes: usize) -> impl Iterator<Item = &T> {
    (0..lanes).filter_map(|lane| of.get(lane).or(of.last()))
}

/// Pack a value of each instance into lanes, as [`padded`]. Return None if there are no instances, or more instances
/// than lanes.
pub fn pack<T, P: SimdValue>(of: &[T], value: impl Fn(&T) -> P::Element) -> Option<P> {
    if of.len() > P::LANES {
        return None;
    }
    let mut packed = P::splat(value(of.first()?));
    for (lane, one) in padded(of, P::LANES).enumerate() {
        packed.replace(lane, value(one));
    }
    Some(packed)
}

/// Return the value that all instances have in common.
pub fn shared<T, V: PartialEq>(of: &[T], value: impl Fn(&T) -> V) -> Option<V> {
    let first = value(of.first()?);
    of.iter().all(|one| value(one) == first).then_some(first)
}

/// Gather a part of each instance, in order.
pub fn part<'a, T, P: 'a, G>(
    of: &[&'a T],
    part: impl Fn(&'a T) -> &'a P,
    gather: impl FnOnce(&[&'a P]) -> Option<G>,
) -> Option<G> {
    gather(&of.iter().map(|one| part(one)).collect::<Vec<_>>())
}

/// Gather a part that all instances have; return None if only some have it.
#[allow(clippy::option_option)] // None: refused; Some(None): absent in all; Some(Some): present in all
pub fn option<'a, T, P: 'a, G>(
    of: &[&'a T],
    part: impl Fn(&'a T) -> Option<&'a P>,
    gather: impl FnOnce(&[&'a P]) -> Option<G>,
) -> Option<Option<G>> {
    let parts: Vec<_> = of.iter().filter_map(|one| part(one)).collect();
    match parts.len() {
        0 => Some(None),
        built if built == of.len() => gather(&parts).map(Some),
        _ => None,
    }
}

/// Iterate over the lanes of a mask, below `count`.
#[inline(always)]
pub fn lanes_of(mask: u64, count: usize) -> impl Iterator<Item = usize> {
    (0..count).filter(move |lane| mask >> lane & 1 == 1)
}

/// Most ticks for which a scenario stays out of its lane after a failed attempt.
const MAX_ABSENCE: u32 = 64;

/// Which of several scenarios are advanced in their lanes; each of the others is advanced by itself.
#[derive(Clone, Debug)]
pub struct Occupancy {
    loaded: u64,
    absences: Vec<Absence>,
}

/// Ticks for which a scenario stays out of its lane.
#[derive(Clone, Copy, Debug, Default)]
struct Absence {
    /// Ticks left.
    remaining: u32,
    /// Ticks at its start.
    length: u32,
}

impl Occupancy {
    /// `count` scenarios, none of them in its lane.
    #[must_use]
    pub fn new(count: usize) -> Self {
        Self { loaded: 0, absences: vec![Absence::default(); count] }
    }

    /// Mask of the lanes that hold their scenario.
    #[inline]
    pub fn loaded(&self) -> u64 {
        self.loaded
    }

    /// Count one tick of the absences among `lanes`; return the mask of those that are over.
    #[inline(never)] // rare
    pub fn due(&mut self, lanes: u64) -> u64 {
        lanes_of(lanes & !self.loaded, self.absences.len()).fold(0, |due, lane| {
            let Absence { remaining, .. } = &mut self.absences[lane];
            *remaining = remaining.saturating_sub(1);
            due | u64::from(*remaining == 0) << lane
        })
    }

    /// Note that a lane holds its scenario.
    pub fn load(&mut self, lane: usize) {
        self.loaded |= 1 << lane;
    }

    /// Empty `lanes`; return the mask of those that held their scenario.
    ///
    /// A lane that was used since its load, a bit in `before`, is free again after one tick. Otherwise the absence is
    /// twice as long as the last.
    #[inline(never)] // rare
    pub fn leave(&mut self, lanes: u64, before: u64) -> u64 {
        let left = lanes & self.loaded;
        for lane in lanes_of(left, self.absences.len()) {
            let Absence { remaining, length } = &mut self.absences[lane];
            *length = if before >> lane & 1 == 1 { 1 } else { (2 * *length).clamp(1, MAX_ABSENCE) };
            *remaining = *length;
        }
        self.loaded &= !left;
        left
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Lanes, WIDTH};

    #[test]
    fn part_of_all_or_none_is_gathered() {
        let half = |parts: &[&f64]| (parts.iter().copied().sum::<f64>() < 100.0).then_some(parts.len());
        let all = |of: &[Option<f64>]| option(&of.iter().collect::<Vec<_>>(), |one| one.as_ref(), half);
        assert_eq!(all(&[Some(1.0), Some(2.0)]), Some(Some(2)));
        assert_eq!(all(&[None, None]), Some(None));
        assert_eq!(all(&[Some(1.0), None]), None);
        assert_eq!(all(&[Some(99.0), Some(2.0)]), None, "refused by the gathering function");
        assert_eq!(part(&[&(1.0, 0), &(2.0, 0), &(3.0, 0)], |one| &one.0, half), Some(3));
        assert_eq!(part(&[&(100.0, 0)], |one| &one.0, half), None);
    }

    #[test]
    fn value_is_shared_if_all_have_it() {
        assert_eq!(shared(&[2, 2, 2], |one| *one), Some(2));
        assert_eq!(shared(&[2, 2, 3], |one| *one), None);
        assert_eq!(shared(&[1, 2, 2], |one| *one), None);
        assert_eq!(shared(&[0; 0], |one: &i32| *one), None);
    }

    #[test]
    fn lanes_are_packed_in_order_and_the_last_fills_the_rest() {
        let numbers = [1.0, 2.0, 3.0];
        let packed: Lanes = pack(&numbers, |one| *one).unwrap();
        for lane in 0..WIDTH {
            assert_eq!(packed.extract(lane), numbers[lane.min(2)]);
        }
        assert!(pack::<_, Lanes>(&[1.0; WIDTH + 1], |one: &f64| *one).is_none());
        assert!(pack::<_, Lanes>(&[], |one: &f64| *one).is_none());
        assert_eq!(pack::<_, f64>(&[7.0], |one| *one), Some(7.0));
    }

    #[test]
    fn an_absence_doubles_until_its_lane_was_used() {
        let mut occupancy = Occupancy::new(3);
        assert_eq!(occupancy.due(0b1110), 0b110);
        occupancy.load(1);
        let mut ticks = |before| {
            assert_eq!((occupancy.due(0b010), occupancy.leave(0b111, before)), (0, 0b010));
            let ticks = (1..100).find(|_| occupancy.due(0b010) == 0b010).unwrap();
            occupancy.load(1);
            ticks
        };
        assert_eq!([0; 8].map(&mut ticks), [1, 2, 4, 8, 16, 32, 64, 64]);
        assert_eq!([0b010, 0].map(ticks), [1, 2]);
    }
}
