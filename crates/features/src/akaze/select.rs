//! A limit on the number of keypoints that keeps them spread over the image.
//!
//! The image is cut into square cells, about one for eight wanted keypoints. In every cell the keypoints are ranked by
//! response; ranks are filled up one after the other, the stronger keypoints of a rank first, so that each cell gives
//! its strongest before any gives its next.

use crate::KeyPoint;

/// Wanted keypoints a cell.
const PER_CELL: usize = 8;

/// Indices, ascending, of at most `limit` keypoints.
pub(crate) fn spread(keypoints: &[KeyPoint], width: u32, height: u32, limit: usize) -> Vec<usize> {
    if keypoints.len() <= limit {
        return (0..keypoints.len()).collect();
    }
    let cells = (limit / PER_CELL).max(1) as f32;
    let side = (width as f32 * height as f32 / cells).sqrt().max(1.0);
    let columns = (width as f32 / side).ceil().max(1.0) as usize;
    let cell = |k: &KeyPoint| (k.y / side) as usize * columns + ((k.x / side) as usize).min(columns - 1);

    let mut order: Vec<usize> = (0..keypoints.len()).collect();
    order.sort_by(|&a, &b| {
        let (ka, kb) = (&keypoints[a], &keypoints[b]);
        cell(ka).cmp(&cell(kb)).then(kb.response.total_cmp(&ka.response)).then(a.cmp(&b))
    });
    let mut ranked = Vec::with_capacity(order.len());
    let mut rank = 0;
    for (i, &k) in order.iter().enumerate() {
        rank = if i > 0 && cell(&keypoints[order[i - 1]]) == cell(&keypoints[k]) { rank + 1 } else { 0 };
        ranked.push((rank, k));
    }
    ranked.sort_by(|&(ra, a), &(rb, b)| {
        ra.cmp(&rb).then(keypoints[b].response.total_cmp(&keypoints[a].response)).then(a.cmp(&b))
    });
    let mut chosen: Vec<usize> = ranked[..limit].iter().map(|&(_, k)| k).collect();
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keypoint(x: f32, y: f32, response: f32) -> KeyPoint {
        KeyPoint { x, y, size: 1.0, angle: 0.0, response, octave: 0, level: 0 }
    }

    #[test]
    fn a_dull_half_of_the_image_keeps_its_fraction() {
        let mut keypoints = Vec::new();
        for i in 0..1000 {
            let (x, y) = ((i % 40) as f32 * 2.5, (i / 40) as f32 * 4.0);
            keypoints.push(keypoint(x, y, 1.0 + i as f32));
            keypoints.push(keypoint(100.0 + x, y, 0.001));
        }
        let chosen = spread(&keypoints, 200, 100, 400);
        assert_eq!(chosen.len(), 400);
        assert!(chosen.windows(2).all(|c| c[0] < c[1]));
        let dull = chosen.iter().filter(|&&i| keypoints[i].x >= 100.0).count();
        assert!((150..=250).contains(&dull), "{dull}");
    }

    #[test]
    fn the_limit_holds_and_few_are_left_alone() {
        let keypoints: Vec<KeyPoint> = (0..20).map(|i| keypoint(i as f32, 0.0, i as f32)).collect();
        assert_eq!(spread(&keypoints, 20, 1, 50).len(), 20);
        assert_eq!(spread(&keypoints, 20, 1, 0).len(), 0);
        assert_eq!(spread(&keypoints, 20, 1, 1), [19]);
    }
}
