//! `tolerance` keeps its promises for every shape, not only where the reference was sampled.

use getup_sim::{Sigmoid, tolerance};
use proptest::prelude::*;

fn sigmoids() -> impl Strategy<Value = Sigmoid> {
    prop::sample::select(vec![Sigmoid::Gaussian, Sigmoid::Linear, Sigmoid::Quadratic, Sigmoid::LongTail])
}

proptest! {
    #[test]
    fn it_is_one_inside_and_its_value_at_the_margin_and_falls_in_between(
        sigmoid in sigmoids(),
        lower in -2.0..2.0_f64,
        width in 0.0..2.0_f64,
        margin in 0.01..3.0_f64,
        value in 0.01..0.99_f64,
        inside in 0.0..=1.0_f64,
        near in 0.0..4.0_f64,
        farther in 0.0..4.0_f64,
    ) {
        let bounds = [lower, lower + width];
        let at = |x| tolerance(x, bounds, margin, value, sigmoid);
        prop_assert_eq!(at((lower + inside * width).clamp(bounds[0], bounds[1])), 1.0);
        for distance in [-margin, margin] {
            let end = if distance < 0.0 { bounds[0] } else { bounds[1] };
            prop_assert!((at(end + distance) - value).abs() < 1e-9);
        }
        let [near, far] = [bounds[1] + near, bounds[1] + near + farther].map(at);
        prop_assert!((0.0..=1.0).contains(&far) && far <= near);
        prop_assert!((at(bounds[1] + 0.7) - at(bounds[0] - 0.7)).abs() < 1e-9, "both sides fall alike");
    }
}
