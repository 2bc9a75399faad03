//! The reward's one building block (App. B.1): how far a number is from where it should be, as a number in [0, 1].

/// The shape of the way down outside the bounds. These are four of the Control Suite's.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Sigmoid {
    /// exp(-x²/2), scaled. Needs `value_at_margin` in (0, 1).
    Gaussian,
    /// Falls along a line, and stays 0 below it. Needs `value_at_margin` in [0, 1).
    Linear,
    /// Falls along a parabola, and stays 0 below it. Needs `value_at_margin` in [0, 1).
    Quadratic,
    /// 1 / (1 + x²), scaled. Needs `value_at_margin` in (0, 1).
    LongTail,
}

/// 1 for `x` inside `bounds` (inclusive), falling outside to `value_at_margin` at the distance `margin`.
///
/// `margin` is in the unit of `x` and must be positive; which `value_at_margin` a shape can reach is said at
/// [`Sigmoid`].
pub fn tolerance(x: f64, bounds: [f64; 2], margin: f64, value_at_margin: f64, sigmoid: Sigmoid) -> f64 {
    let [lower, upper] = bounds;
    debug_assert!(lower <= upper && margin > 0.0 && (0.0..1.0).contains(&value_at_margin));
    if lower <= x && x <= upper {
        return 1.0;
    }
    let outside = if x < lower { lower - x } else { x - upper };
    falloff(outside / margin, value_at_margin, sigmoid)
}

/// 1 at `x = 0` and `value_at_1` at `x = 1`.
fn falloff(x: f64, value_at_1: f64, sigmoid: Sigmoid) -> f64 {
    match sigmoid {
        Sigmoid::Gaussian => {
            let scale = (-2.0 * value_at_1.ln()).sqrt();
            (-0.5 * (x * scale).powi(2)).exp()
        }
        Sigmoid::Linear => (1.0 - x * (1.0 - value_at_1)).max(0.0),
        Sigmoid::Quadratic => {
            let scaled = x * (1.0 - value_at_1).sqrt();
            (1.0 - scaled * scaled).max(0.0)
        }
        Sigmoid::LongTail => {
            let scale = (1.0 / value_at_1 - 1.0).sqrt();
            1.0 / ((x * scale).powi(2) + 1.0)
        }
    }
}
