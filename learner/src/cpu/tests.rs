//! The written-out update against autograd, network by network and thread by thread.

use std::io::Write;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::Device;

use super::factors::{Factors, Purpose, Right};
use super::layout::{self, Layout, Places};
use super::memory::Memory;
use super::optimizer::{self, AdamRows, AdamStep, PolyakRows};
use super::product::{Format, Panel, Product, Size};
use super::rows::{AsTheyAre, BiasRelu, Gradient, Normal, Passed, Rows};
use super::transpose;
use crate::config::{NetworkKind, Precision, SacConfig};
use crate::parameters::to_vec;
use crate::sac::{Batch, Losses, Sac, TaskShape};

const SHAPE: TaskShape = TaskShape { observation: 13, action: 3, unnormalized: vec![] };

fn random(count: usize, low: f32, high: f32, rng: &mut ChaCha8Rng) -> Vec<f32> {
    (0..count).map(|_| rng.random_range(low..high)).collect()
}

fn batch(rows: usize, rng: &mut ChaCha8Rng) -> Batch {
    Batch {
        observation: random(rows * SHAPE.observation, -2.0, 2.0, rng),
        action: random(rows * SHAPE.action, -0.9, 0.9, rng),
        reward: random(rows, 0.0, 1.0, rng),
        next_observation: random(rows * SHAPE.observation, -2.0, 2.0, rng),
        discount: random(rows, 0.0, 0.97, rng),
        beta: random(rows, 0.4, 1.6, rng),
        weight: Vec::new(),
    }
}

/// Networks of every kind, with widths and batches that are no multiples of a vector.
fn configurations() -> Vec<SacConfig> {
    let base = SacConfig {
        actor_lr: 1e-3,
        critic_lr: 1e-3,
        temperature_lr: 1e-3,
        weight_decay: 0.01,
        normalize_observations: true,
        precision: Precision::Fp32,
        ..SacConfig::default()
    };
    let mlp = |hidden: &[usize], critics| SacConfig { hidden: hidden.to_vec(), critics, ..base.clone() };
    let simba = |actor: (usize, usize), critic: (usize, usize), critics| SacConfig {
        network: NetworkKind::Simba,
        actor_width: actor.0,
        actor_blocks: actor.1,
        critic_width: critic.0,
        critic_blocks: critic.1,
        critics,
        ..base.clone()
    };
    vec![
        mlp(&[32, 32], 2),
        mlp(&[19, 7, 24], 3),
        mlp(&[90, 130], 1),
        mlp(&[530, 20], 1),
        simba((16, 1), (32, 2), 1),
        simba((9, 2), (17, 1), 2),
        simba((8, 0), (8, 0), 1),
    ]
}

/// Sums of parameters of actor, critics and targets, and what the updates found.
fn parameters(sac: &Sac) -> Vec<f32> {
    [&sac.actor.parameters, &sac.critics.parameters, &sac.targets.parameters]
        .into_iter()
        .flat_map(|parameters| to_vec(parameters.flat()))
        .collect()
}

fn train(config: &SacConfig, threads: usize, rows: usize, autograd: bool) -> (Vec<f32>, Losses) {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let mut sac = Sac::new(&SHAPE, config, 1, Device::Cpu, threads);
    // Without products of its own an update goes through autograd, and would be compared with itself.
    let own = sac.multiply(rows);
    assert!(autograd || own || config.precision != Precision::Fp32 || !Format::F32.works());
    let mut losses = Losses::default();
    for _ in 0..4 {
        let batch = batch(rows, &mut rng);
        sac.merge_statistics(&batch);
        let noise = random(rows * SHAPE.action, -2.0, 2.0, &mut rng);
        let next_noise = random(rows * SHAPE.action, -2.0, 2.0, &mut rng);
        losses = match autograd {
            true => sac.update_by_autograd(&batch, &next_noise, &noise),
            false => sac.update_with_noise(&batch, &next_noise, &noise),
        }
        .unwrap();
    }
    (parameters(&sac), losses)
}

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn in_float32_four_updates_are_autograds_for_every_network_batch_and_number_of_threads() {
    for config in configurations() {
        for (rows, threads) in [(5, 1), (48, 1), (50, 2), (33, 3), (1030, 1)] {
            let (exact, exact_losses) = train(&config, 1, rows, true);
            let (ours, losses) = train(&config, threads, rows, false);
            // Adam's first steps divide a gradient by its own size: one near zero may go either way by a rounding.
            let apart = exact.iter().zip(&ours).filter(|(a, b)| (*a - *b).abs() >= 2e-4).count();
            assert!(apart * 5_000 <= ours.len(), "{config:?}, {rows} rows, {threads} threads: {apart} apart");
            let mean = exact.iter().zip(&ours).map(|(a, b)| (a - b).abs()).sum::<f32>() / ours.len() as f32;
            assert!(mean < 1e-6, "{config:?}, {rows} rows, {threads} threads: {mean} on average");
            for (ours, theirs) in [
                (losses.critic, exact_losses.critic),
                (losses.actor, exact_losses.actor),
                (losses.entropy, exact_losses.entropy),
                (losses.q, exact_losses.q),
                (losses.temperature, exact_losses.temperature),
            ] {
                assert!((ours - theirs).abs() < 1e-4 * theirs.abs().max(1.0), "{losses:?} {exact_losses:?}");
            }
        }
    }
}

#[test]
fn in_bfloat16_updates_stay_within_its_rounding_of_float32() {
    for config in configurations() {
        let bf16 = SacConfig { precision: Precision::Bf16, ..config.clone() };
        let (exact, exact_losses) = train(&config, 1, 48, false);
        let (rounded, losses) = train(&bf16, 2, 48, false);
        let mean = exact.iter().zip(&rounded).map(|(a, b)| (a - b).abs()).sum::<f32>() / exact.len() as f32;
        assert!(mean > 0.0 && mean < 5e-4, "{config:?}: {mean} on average");
        assert!((losses.critic - exact_losses.critic).abs() < 0.05 * exact_losses.critic.max(0.1));
    }
}

#[test]
fn the_same_minibatches_give_the_same_bits_on_the_same_number_of_threads() {
    for config in configurations() {
        for threads in [1, 2] {
            assert_eq!(train(&config, threads, 50, false).0, train(&config, threads, 50, false).0);
        }
    }
}

/// A number as bfloat16 holds it.
fn round(value: f32) -> f32 {
    f32::from_bits((value.to_bits() + 0x7fff + ((value.to_bits() >> 16) & 1)) & 0xffff_0000)
}

#[test]
fn a_product_is_that_of_the_rounded_numbers_in_one_block_and_in_many() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for format in [Format::F32, Format::Bf16] {
        if !format.works() {
            // Past the test harness, which keeps to itself what a test that passes prints.
            let _ = writeln!(
                std::io::stderr(),
                "skipped: libtorch has no product in {format:?} for this processor"
            );
            continue;
        }
        let rounded = |value: f32| if format == Format::Bf16 { round(value) } else { value };
        for (m, n, k) in [(5, 16, 7), (600, 48, 31), (7, 528, 600), (70, 32, 1100), (20, 272, 300)] {
            let (a, b) = (random(m * k, -1.0, 1.0, &mut rng), random(k * n, -1.0, 1.0, &mut rng));
            let memory = &mut Memory::default();
            let (mut right, mut factors) =
                (Right::new(k, n, memory), Factors::new(format, [k, 1, n], false, memory));
            let rows = &mut AsTheyAre { first: 0, values: &b, length: n };
            factors.pack_input(0..k, rows, Purpose::Results, &mut right);
            let padded = format.padded(k);
            let mut left = vec![0u32; m * padded / format.per_word()];
            for (row, a) in a.chunks_exact(k).enumerate() {
                for (column, value) in a.iter().enumerate() {
                    let place = row * padded + column;
                    left[place / format.per_word()] |= match format {
                        Format::F32 => value.to_bits(),
                        Format::Bf16 => (round(*value).to_bits() >> 16) << (16 * (column % 2)),
                    };
                }
            }
            let size = Size { m, n, k: padded };
            let mut result = vec![1.0; m * n];
            for accumulate in [false, true] {
                Product { format, size, lda: padded, ldb: n, ldc: n, accumulate }.run(
                    &left,
                    right.words(),
                    &mut result,
                );
            }
            if format == Format::F32 {
                let mut by_panel = vec![1.0; m * n];
                for accumulate in [false, true] {
                    let product = Product { format, size, lda: padded, ldb: n, ldc: n, accumulate };
                    assert!(product.run_by_blocks(&left, right.words(), &mut by_panel, Some(Panel::new())));
                }
                let difference = largest_difference(&by_panel, &result);
                assert!(difference < 1e-3, "{m} × {n} × {k}: {difference}");
            }
            for row in 0..m {
                for column in 0..n {
                    let term =
                        |i: usize| f64::from(rounded(a[row * k + i])) * f64::from(rounded(b[i * n + column]));
                    let error = f64::from(result[row * n + column]) - 2.0 * (0..k).map(term).sum::<f64>();
                    assert!(error.abs() < 1e-3, "{format:?}, {m} × {n} × {k}: {error} at [{row}, {column}]");
                }
            }
        }
    }
}

#[test]
fn words_are_transposed_whatever_the_sides() {
    for (rows, columns) in [(1, 1), (16, 16), (3, 40), (40, 3), (33, 50), (128, 64)] {
        let words: Vec<u32> = (0..rows * columns).collect();
        let (rows, columns) = (rows as usize, columns as usize);
        for stride in [rows, rows + 5] {
            let (mut turned, mut plainly) = (vec![7; stride * columns], vec![7; stride * columns]);
            transpose::transpose(&words, rows, columns, &mut turned, stride);
            transpose::transpose_by_words(&words, columns, &mut plainly, stride, 0..rows, 0..columns);
            assert_eq!(turned, plainly, "{rows} × {columns}");
            #[cfg(target_arch = "x86_64")]
            if is_x86_feature_detected!("avx2") {
                let mut narrowly = vec![7; stride * columns];
                // SAFETY: the processor has AVX2, and both hold rows × columns words at their strides.
                unsafe { transpose::transpose_avx2(&words, rows, columns, &mut narrowly, stride) };
                assert_eq!(narrowly, plainly, "{rows} × {columns}");
            }
            for (place, word) in turned.iter().enumerate() {
                let (column, row) = (place / stride, place % stride);
                let wanted = if row < rows { words[row * columns + column] } else { 7 };
                assert_eq!(*word, wanted, "{rows} × {columns}");
            }
        }
    }
}

#[test]
fn rows_are_packed_to_the_nearest_number_and_in_pairs_whatever_the_sides() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    for (rows, columns) in [(2, 16), (3, 40), (7, 33), (1, 5)] {
        let mut values = random(rows * columns, -3.0, 3.0, &mut rng);
        values[0] = f32::INFINITY;
        values[columns - 1] = 1.0 + 2.0f32.powi(-9); // Halfway between two numbers of bfloat16.
        let stride = columns + 3;
        let (mut plain, mut pairs) = (vec![7u16; rows * stride], vec![0u32; rows.div_ceil(2) * columns]);
        let layout = Layout { length: columns, stride };
        let mut source = AsTheyAre { first: 0, values: &values, length: columns };
        let places = Places { plain: &mut plain, pairs: &mut pairs, signs: &mut [] };
        layout::pack_bf16(&mut source, 0..rows, layout, places);
        for (index, value) in values.iter().enumerate() {
            let (row, column) = (index / columns, index % columns);
            let packed = plain[row * stride + column];
            let wanted = if value.is_finite() { round(*value) } else { *value };
            assert_eq!(f32::from_bits(u32::from(packed) << 16), wanted);
            assert_eq!((pairs[row / 2 * columns + column] >> (16 * (row % 2))) as u16, packed);
            if row + 1 == rows && row % 2 == 0 {
                assert_eq!(pairs[row / 2 * columns + column] >> 16, 0);
            }
        }
        for row in plain.chunks_exact(stride) {
            assert_eq!(row[columns..], [7; 3]);
        }
        let mut written = vec![0.0; values.len()];
        layout::write(&mut source, 0..rows, columns, &mut written, &mut []);
        assert_eq!(written, values);
    }
}

#[test]
fn an_actor_whose_critics_come_first_stays_as_it_is_until_they_had_their_updates() {
    for autograd in [false, true] {
        let config = SacConfig { critics_first: 3, ..configurations().remove(0) };
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut sac = Sac::new(&SHAPE, &config, 1, Device::Cpu, 1);
        let state = |sac: &Sac| (to_vec(sac.actor.parameters.flat()), sac.log_temperature);
        let (before, critics) = (state(&sac), to_vec(sac.critics.parameters.flat()));
        for update in 0..4 {
            assert_eq!(state(&sac), before, "before update {update}");
            let batch = batch(16, &mut rng);
            let noise = random(16 * SHAPE.action, -2.0, 2.0, &mut rng);
            match autograd {
                true => sac.update_by_autograd(&batch, &noise, &noise).unwrap(),
                false => sac.update_with_noise(&batch, &noise, &noise).unwrap(),
            };
            assert_ne!(to_vec(sac.critics.parameters.flat()), critics);
        }
        assert_ne!(state(&sac), before);
    }
}

#[test]
fn a_delayed_policy_learns_by_its_updates_only_and_the_critics_by_all() {
    for autograd in [false, true] {
        let config = SacConfig { policy_delay: 2, actor_average: 0.5, ..configurations().remove(0) };
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut sac = Sac::new(&SHAPE, &config, 1, Device::Cpu, 1);
        let actor = |sac: &Sac| {
            let average = to_vec(sac.average.as_ref().unwrap());
            (to_vec(sac.actor.parameters.flat()), average, sac.log_temperature)
        };
        let mut losses = Losses::default();
        for update in 0..5 {
            let (before, critics) = (actor(&sac), to_vec(sac.critics.parameters.flat()));
            let batch = batch(16, &mut rng);
            let noise = random(16 * SHAPE.action, -2.0, 2.0, &mut rng);
            let last = losses;
            losses = match autograd {
                true => sac.update_by_autograd(&batch, &noise, &noise).unwrap(),
                false => sac.update_with_noise(&batch, &noise, &noise).unwrap(),
            };
            let learns = update % 2 == 0;
            assert_eq!(actor(&sac) != before, learns, "update {update}");
            // What was found of the actor stays that of its last update.
            assert_eq!(
                (losses.actor, losses.entropy) != (last.actor, last.entropy),
                learns,
                "update {update}"
            );
            assert_ne!(to_vec(sac.critics.parameters.flat()), critics, "update {update}");
        }
    }
}

/// What came of laying rows out: plain, pairs and signs.
type LaidOut = (Vec<u16>, Vec<u32>, Vec<u32>);

/// `[F, R]`, lanes and what is left of them.
const SIDES: [usize; 2] = [7, 48];

/// Lays out rows by the processor's own instructions, where it has them, or part after part.
fn lay_out(rows: &mut impl Rows, by_parts: bool) -> LaidOut {
    let [features, length] = SIDES;
    let (mut plain, pairs) = (vec![0; features * length], features.div_ceil(2) * length);
    let (mut pairs, mut signs) = (vec![0; pairs], vec![0; pairs / layout::LANES]);
    let places = Places { plain: &mut plain, pairs: &mut pairs, signs: &mut signs };
    let layout = Layout { length, stride: length };
    match by_parts {
        true => layout::pack_parts(rows, 0..features, layout, 0, places),
        false => layout::pack_bf16(rows, 0..features, layout, places),
    }
    (plain, pairs, signs)
}

/// Writes rows as they are, likewise: their bits, and their signs.
fn write_out(rows: &mut impl Rows, by_parts: bool) -> (Vec<u32>, Vec<u32>) {
    let [features, length] = SIDES;
    let mut signs = vec![0; features.div_ceil(2) * length / layout::LANES];
    let mut written = vec![0.0; features * length];
    match by_parts {
        true => layout::write_parts(rows, 0..features, length, 0, &mut written, &mut signs),
        false => layout::write(rows, 0..features, length, &mut written, &mut signs),
    }
    (written.into_iter().map(f32::to_bits).collect(), signs)
}

#[test]
fn what_lies_between_products_is_the_same_by_lanes_and_by_parts() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let [features, length] = SIDES;
    let mut matrix = || random(features * length, -2.0, 2.0, &mut rng);
    let (mut values, result) = (matrix(), matrix());
    values[3] = f32::NAN;
    let bias: Vec<f32> = (0..features).map(|row| row as f32 / 4.0 - 1.0).collect();
    let relu = |by_parts| {
        let mut rows = BiasRelu { first: 0, values: &values, bias: &bias, rows: length };
        (lay_out(&mut rows, by_parts), write_out(&mut rows, by_parts))
    };
    assert_eq!(relu(false), relu(true));
    let ((plain, _, signs), (_, written_signs)) = relu(false);
    assert_eq!(signs, written_signs);
    assert!(f32::from_bits(u32::from(plain[3]) << 16).is_nan(), "a NaN stays one");
    for (place, bits) in plain.iter().enumerate().filter(|(place, _)| *place != 3) {
        let (row, at) = (place / length, place % length);
        let word = signs[(row / 2 * length + at) / layout::LANES];
        assert_eq!(word >> (row % 2 * layout::LANES + at % layout::LANES) & 1 == 1, *bits > 0, "{row}, {at}");
    }
    values[3] = 1.0;
    for passed in [Passed::All, Passed::Positive(&result), Passed::Signs(&signs)] {
        let gradient = |by_parts| {
            let mut sums = vec![0.0; features];
            let sums_too = Some(&mut sums[..]);
            let mut rows = Gradient { first: 0, values: &values, passed, rows: length, sums: sums_too };
            let laid_out = (lay_out(&mut rows, by_parts), write_out(&mut rows, by_parts));
            (laid_out, sums)
        };
        let ((lanes, lane_sums), (parts, part_sums)) = (gradient(false), gradient(true));
        assert_eq!(lanes, parts);
        assert!(largest_difference(&lane_sums, &part_sums) < 1e-4);
        assert!(lane_sums.iter().all(|sum| sum.abs() > 1e-3));
    }
    let (mean, inverse) = (&result[..length], &result[length..2 * length]);
    let normal = |by_parts| {
        let (mut normal, weight) = (vec![0.0; values.len()], &result[..features]);
        let normal_too = &mut normal;
        let mut rows = Normal { x: &values, mean, inverse, weight, bias: &bias, normal: normal_too };
        (lay_out(&mut rows, by_parts), normal)
    };
    let ((lanes, kept), (parts, also_kept)) = (normal(false), normal(true));
    assert_eq!(kept, also_kept);
    // A multiplication and an addition may be one rounding or two.
    for (lanes, parts) in lanes.0.iter().zip(&parts.0) {
        let [lanes, parts] = [lanes, parts].map(|bits| f32::from_bits(u32::from(*bits) << 16));
        assert!((lanes - parts).abs() <= 0.01 * parts.abs() + 1e-6, "{lanes} {parts}");
    }
}

#[test]
fn a_step_by_estimates_is_the_exact_one_within_float32s_rounding() {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let [features, length] = SIDES;
    let step = AdamStep { rate: 1e-3, root: 30.0, decay: 1e-5, beta1: 0.9, beta2: 0.999, epsilon: 1e-8 };
    // Gradients of every size, and none.
    let mut gradient = random(features * length, -1.0, 1.0, &mut rng);
    for (index, gradient) in gradient.iter_mut().enumerate() {
        *gradient *= 10.0f32.powi(index as i32 % 24 - 20);
    }
    gradient[..8].fill(0.0);
    let before = random(features * length, -1.0, 1.0, &mut rng);
    let take = |exactly: bool| {
        let [mut first, mut second] = [(); 2].map(|()| vec![0.0; before.len()]);
        let (mut values, mut target) = (before.clone(), vec![0.5; before.len()]);
        for _ in 0..3 {
            let (values, gradient) = (&mut values[..], &gradient[..]);
            let (first, second) = (&mut first[..], &mut second[..]);
            match exactly {
                true => optimizer::adam_numbers(step, values, gradient, first, second),
                false => {
                    let mut rows =
                        AdamRows { step, inputs: length, start: 0, values, first, second, gradient };
                    lay_out(&mut rows, false);
                }
            }
        }
        let mut rows =
            PolyakRows { tau: 0.1, inputs: length, start: 0, target: &mut target, values: &values };
        lay_out(&mut rows, exactly);
        [values, first, second, target]
    };
    for (estimated, exact) in take(false).iter().zip(&take(true)) {
        for (estimated, exact) in estimated.iter().zip(exact) {
            assert!((estimated - exact).abs() <= 1e-6 * exact.abs() + 1e-9, "{estimated} for {exact}");
        }
    }
    assert!(largest_difference(&take(true)[0], &before) > 1e-4);
}
