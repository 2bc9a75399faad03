//! Initial weights: orthogonal matrices and zero biases (App. D).

use rand::Rng;
use rand_distr::StandardNormal;

use crate::Body;

/// A `[rows, columns]` matrix, row-major, whose shorter side is orthonormal, times `gain`.
///
/// Gram–Schmidt, applied twice, on Gaussian vectors: their span is uniform over all subspaces.
pub fn orthogonal(rows: usize, columns: usize, gain: f32, rng: &mut impl Rng) -> Vec<f32> {
    let (count, length) = (rows.min(columns), rows.max(columns));
    let mut vectors: Vec<Vec<f32>> = Vec::with_capacity(count);
    while vectors.len() < count {
        let mut vector: Vec<f32> = (0..length).map(|_| rng.sample(StandardNormal)).collect();
        for _ in 0..2 {
            for other in &vectors {
                let projection = dot(&vector, other);
                vector.iter_mut().zip(other).for_each(|(x, y)| *x -= projection * y);
            }
        }
        let norm = dot(&vector, &vector).sqrt();
        if norm > 1e-3 {
            vector.iter_mut().for_each(|x| *x /= norm);
            vectors.push(vector);
        }
    }
    let mut matrix = vec![0.0; rows * columns];
    for (index, vector) in vectors.iter().enumerate() {
        for (position, value) in vector.iter().enumerate() {
            let (row, column) = if rows <= columns { (index, position) } else { (position, index) };
            matrix[row * columns + column] = gain * value;
        }
    }
    matrix
}

/// The body's initial tensors, in the order of [`Body::tensors`].
pub fn body(body: &Body, inputs: usize, rng: &mut impl Rng) -> Vec<(String, Vec<usize>, Vec<f32>)> {
    let init = |(name, shape): (String, Vec<usize>)| {
        let values = match shape[..] {
            [rows, columns] if name.ends_with(".up.weight") || name.ends_with(".down.weight") => {
                let std = (2.0 / columns as f32).sqrt();
                (0..rows * columns).map(|_| std * rng.sample::<f32, _>(StandardNormal)).collect()
            }
            [rows, columns] => orthogonal(rows, columns, 1.0, rng),
            [width] if name.ends_with("norm.weight") => vec![1.0; width],
            _ => vec![0.0; shape[0]],
        };
        (name, shape, values)
    };
    body.tensors(inputs).into_iter().map(init).collect()
}

/// Sums in eight independent parts, which vectorises.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut parts = [0.0f32; 8];
    let (a_chunks, b_chunks) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f32 = a_chunks.remainder().iter().zip(b_chunks.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a_chunks.zip(b_chunks) {
        for lane in 0..8 {
            parts[lane] += x[lane] * y[lane];
        }
    }
    parts.iter().sum::<f32>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn the_shorter_side_is_orthonormal_times_the_gain() {
        for (rows, columns) in [(3, 7), (7, 3), (64, 64), (1, 5), (256, 68)] {
            let matrix = orthogonal(rows, columns, 2.0, &mut ChaCha8Rng::seed_from_u64(7));
            let vector = |index: usize| -> Vec<f32> {
                if rows <= columns {
                    matrix[index * columns..(index + 1) * columns].to_vec()
                } else {
                    (0..rows).map(|row| matrix[row * columns + index]).collect()
                }
            };
            for i in 0..rows.min(columns) {
                for j in 0..=i {
                    let wanted = if i == j { 4.0 } else { 0.0 };
                    assert!((dot(&vector(i), &vector(j)) - wanted).abs() < 1e-5, "{rows}x{columns} {i} {j}");
                }
            }
        }
    }
}
