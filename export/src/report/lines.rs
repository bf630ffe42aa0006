//! Lines with no more points than can be seen.

/// How far a line may be from where it was, pixels.
const TOLERANCE_PX: f64 = 0.35;

/// The pieces of a course in which something stays the same, each with the first sample of the next one, so that
/// they join.
pub fn split<S: Copy, K: PartialEq>(samples: &[S], key: impl Fn(&S) -> K) -> Vec<Vec<S>> {
    let mut pieces: Vec<Vec<S>> = Vec::new();
    for piece in samples.chunk_by(|a, b| key(a) == key(b)) {
        if let Some(last) = pieces.last_mut() {
            last.push(piece[0]);
        }
        pieces.push(piece.to_vec());
    }
    pieces
}

/// The line with fewer points, nowhere further away than can be seen (Douglas and Peucker); `scale` is pixels per unit.
pub fn simplified(points: impl Iterator<Item = (f64, f64)>, scale: (f64, f64)) -> Vec<(f64, f64)> {
    let all: Vec<(f64, f64)> = points.collect();
    if all.len() < 3 {
        return all;
    }
    let mut keep = vec![false; all.len()];
    (keep[0], keep[all.len() - 1]) = (true, true);
    let mut open = vec![(0, all.len() - 1)];
    while let Some((from, to)) = open.pop() {
        let farthest = (from + 1..to)
            .map(|at| (at, distance_px(all[at], all[from], all[to], scale)))
            .max_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((at, distance)) = farthest
            && distance > TOLERANCE_PX
        {
            keep[at] = true;
            open.extend([(from, at), (at, to)]);
        }
    }
    all.into_iter().zip(keep).filter(|(_, keep)| *keep).map(|(point, _)| point).collect()
}

/// Distance of a point from the line between two others, pixels.
fn distance_px(point: (f64, f64), from: (f64, f64), to: (f64, f64), scale: (f64, f64)) -> f64 {
    let px = |p: (f64, f64)| ((p.0 - from.0) * scale.0, (p.1 - from.1) * scale.1);
    let ((x, y), (dx, dy)) = (px(point), px(to));
    let length = dx.hypot(dy);
    if length == 0.0 { x.hypot(y) } else { (x * dy - y * dx).abs() / length }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_keeps_its_corners_and_loses_what_lies_between() {
        let line = (0..=100).map(|i| (f64::from(i), if i <= 50 { 0.0 } else { f64::from(i - 50) }));
        assert_eq!(simplified(line, (1.0, 1.0)), [(0.0, 0.0), (50.0, 0.0), (100.0, 50.0)]);
    }

    #[test]
    fn pieces_join() {
        assert_eq!(split(&[1, 1, 2, 2, 3], |n| *n), [vec![1, 1, 2], vec![2, 2, 3], vec![3]]);
    }
}
