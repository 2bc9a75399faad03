//! Falls are the paper's (§7): where they start, how long they last, how they end.
//!
//! The statistical tests draw 10,000 initial poses from fixed seeds, so they pass or fail for good. Each critical
//! value is that of one test at the 1e-4 level: the ninety tests made here would fail a correct sampler on one seed
//! in a hundred. Landings are counted on as many falls, a minute on two cores.

use std::f64::consts::PI;
use std::sync::Arc;

use getup_sim::falls::{self, Falls, Landing, Landings};
use getup_sim::{Character, Fall, GetUp, Lane, Phase, Source, Task, TaskConfig, World};
use rand::{Rng, SeedableRng};
use rand_chacha::{ChaCha8Rng, ChaCha20Rng};

const DRAWS: usize = 10_000;

/// Kolmogorov-Smirnov at the 1e-4 level: sqrt(-ln(1e-4 / 2) / 2) / sqrt(n).
fn ks_critical(n: usize) -> f64 {
    (-(0.5e-4_f64).ln() / 2.0).sqrt() / (n as f64).sqrt()
}

/// The largest distance between the samples' distribution and `cdf`.
fn ks_distance(mut samples: Vec<f64>, cdf: impl Fn(f64) -> f64) -> f64 {
    samples.sort_by(f64::total_cmp);
    let n = samples.len() as f64;
    let distance = |(i, x): (usize, &f64)| (cdf(*x) - i as f64 / n).max((i as f64 + 1.0) / n - cdf(*x));
    samples.iter().enumerate().map(distance).fold(0.0, f64::max)
}

fn assert_distributed(what: &str, samples: Vec<f64>, cdf: impl Fn(f64) -> f64) {
    let critical = ks_critical(samples.len());
    let distance = ks_distance(samples, cdf);
    assert!(distance < critical, "{what}: KS distance {distance:.4} is over {critical:.4}");
}

fn task(character: Character) -> Arc<GetUp> {
    Arc::new(GetUp::new(&TaskConfig { character, ..TaskConfig::default() }, 1.0).unwrap())
}

fn fall(task: &GetUp) -> Fall {
    let Source::Fall(fall) = task.resets().draw(&mut ChaCha8Rng::seed_from_u64(0));
    fall.clone()
}

/// The first poses of 10,000 episodes.
fn initial_poses(task: &Arc<GetUp>) -> Vec<Vec<f64>> {
    let mut lane = Lane::new(task.clone());
    let begin = |seed| {
        lane.begin(seed, 1.0);
        assert_eq!(lane.phase(), Phase::Limp);
        assert_eq!(lane.world().contacts(), 0, "episode {seed} begins in contact");
        assert!(lane.qvel().iter().all(|&v| v == 0.0), "episode {seed} begins in motion");
        lane.qpos().to_vec()
    };
    (0..DRAWS as u64).map(begin).collect()
}

/// A rotation matrix by rows, from a unit quaternion w x y z.
fn matrix([w, x, y, z]: [f64; 4]) -> [f64; 9] {
    [
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    ]
}

#[test]
fn ten_thousand_falls_begin_a_metre_and_a_half_up_uniform_on_so3_and_touching_nothing() {
    let poses = initial_poses(&task(Character::Standard));
    assert!(poses.iter().all(|qpos| qpos[..3] == [0.0, 0.0, 1.5]));
    let quaternions: Vec<[f64; 4]> = poses.iter().map(|qpos| qpos[3..7].try_into().unwrap()).collect();
    // On the unit sphere every coordinate is uniform (Archimedes); each column of a uniform rotation is a uniform
    // point of it, and so is each row.
    for entry in 0..9 {
        let samples = quaternions.iter().map(|&q| matrix(q)[entry]).collect();
        assert_distributed(&format!("rotation[{entry}]"), samples, |x| (x + 1.0) / 2.0);
    }
    // The rotation by an angle: |w| = cos(angle / 2) has the density of a coordinate on the 3-sphere.
    let w = quaternions.iter().map(|q| q[0].abs()).collect();
    assert_distributed("|w|", w, |w| 2.0 / PI * (w * (1.0 - w * w).sqrt() + w.asin()));
    // Jointly: the axis and the heading fall into each of the 16 orthants of the 3-sphere equally often.
    let mut orthants = [0.0; 16];
    for q in &quaternions {
        orthants[q.iter().fold(0, |index, &x| index * 2 + usize::from(x > 0.0))] += 1.0;
    }
    let expected = DRAWS as f64 / 16.0;
    let chi_square: f64 = orthants.iter().map(|count: &f64| (count - expected).powi(2) / expected).sum();
    assert!(chi_square < 44.3, "orthants: chi-square {chi_square:.1} is over 44.3 (15 degrees, 1e-4)");
}

#[test]
fn every_hinge_is_proposed_uniformly_in_its_range() {
    for character in Character::ALL {
        let task = task(character);
        let (fall, world) = (fall(&task), task.world());
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut qpos = vec![0.0; world.nq()];
        let proposals: Vec<Vec<f64>> = (0..DRAWS)
            .map(|_| {
                fall.propose(&world, &mut rng, &mut qpos);
                qpos.clone()
            })
            .collect();
        for (hinge, [lower, upper]) in world.hinge_ranges().iter().enumerate() {
            let samples = proposals.iter().map(|qpos| qpos[7 + hinge]).collect();
            let cdf = |x: f64| (x - lower) / (upper - lower);
            assert_distributed(&format!("{character} hinge {hinge}"), samples, cdf);
        }
    }
}

#[test]
fn a_fall_begins_at_the_first_proposal_that_touches_nothing() {
    let task = task(Character::Standard);
    let (fall, mut world) = (fall(&task), task.world());
    let [mut drawing, mut proposing] = [2, 2].map(ChaCha8Rng::seed_from_u64);
    let [mut drawn, mut proposed] = [vec![0.0; world.nq()], vec![0.0; world.nq()]];
    let mut total = 0;
    for _ in 0..DRAWS {
        let draws = fall.draw_pose(&mut world, &mut drawing, &mut drawn);
        for draw in 1..=draws {
            fall.propose(&world, &mut proposing, &mut proposed);
            assert_eq!(world.touches_at(&proposed), draw < draws);
        }
        assert_eq!(drawn, proposed);
        total += draws;
    }
    let mean = total as f64 / DRAWS as f64;
    assert!((1.28..1.38).contains(&mean), "{mean} proposals a fall");
}

/// Counts of one hinge's angles in 20 equal parts of its range.
fn histogram(angles: impl Iterator<Item = f64>, [lower, upper]: [f64; 2]) -> [f64; 20] {
    let mut counts = [0.0; 20];
    for angle in angles {
        counts[((angle - lower) / (upper - lower) * 20.0).clamp(0.0, 19.0) as usize] += 1.0;
    }
    counts
}

/// Poses of the hinges alone, upright, by another generator and another way to draw: what the contact rejection
/// leaves of uniform hinges.
fn untouching_hinges(world: &mut World, count: usize) -> Vec<Vec<f64>> {
    let mut rng = ChaCha20Rng::seed_from_u64(3);
    let mut qpos = vec![0.0; world.nq()];
    qpos[2..4].copy_from_slice(&[1.5, 1.0]);
    let mut kept = Vec::new();
    while kept.len() < count {
        for (hinge, [lower, upper]) in world.hinge_ranges().iter().enumerate() {
            qpos[7 + hinge] = lower + rng.random::<f64>() * (upper - lower);
        }
        if !world.touches_at(&qpos) {
            kept.push(qpos[7..].to_vec());
        }
    }
    kept
}

#[test]
fn every_hinge_is_uniform_apart_from_the_contact_rejection() {
    let task = task(Character::Standard);
    let poses = initial_poses(&task);
    let mut world = task.world();
    let reference = untouching_hinges(&mut world, 10 * DRAWS);
    let ratio = (reference.len() as f64 / poses.len() as f64).sqrt();
    for (hinge, &range) in world.hinge_ranges().iter().enumerate() {
        let ours = histogram(poses.iter().map(|qpos| qpos[7 + hinge]), range);
        let theirs = histogram(reference.iter().map(|angles| angles[hinge]), range);
        let difference = |(a, b): (&f64, &f64)| (a * ratio - b / ratio).powi(2) / (a + b);
        let chi_square: f64 = ours.iter().zip(&theirs).map(difference).sum();
        assert!(
            chi_square < 51.1,
            "hinge {hinge}: chi-square {chi_square:.1} is over 51.1 (19 degrees, 1e-4)"
        );
    }
    // And the rejection does what its documentation says: the most flexed tenth of a knee is rare.
    let knee = histogram(reference.iter().map(|angles| angles[6]), world.hinge_ranges()[6]);
    let share = (knee[0] + knee[1]) / reference.len() as f64;
    assert!((0.053..0.063).contains(&share), "the most flexed tenth of the knee has a share of {share}");
}

#[test]
fn falls_take_eighty_limp_steps_and_land_supine_prone_and_on_a_side() {
    let count = DRAWS;
    let Falls { falls, landings, .. } = falls::draw(&TaskConfig::default(), count, 4).unwrap();
    assert_eq!(falls.len(), count);
    assert!(falls.iter().all(|fall| fall.limp_steps == 80));
    let Landings { supine, prone, lateral } = landings;
    assert_eq!(supine + prone + lateral, count);
    // The shares of 10,000 falls; a sample's may be four of its standard deviations off.
    for (name, landed, expected) in
        [("supine", supine, 0.464), ("prone", prone, 0.309), ("lateral", lateral, 0.227_f64)]
    {
        let share = landed as f64 / count as f64;
        println!("{name}: {landed} of {count}, {:.1} %", 100.0 * share);
        let slack = 4.0 * (expected * (1.0 - expected) / count as f64).sqrt();
        assert!((share - expected).abs() < slack, "{landed} of {count} falls land {name}");
    }
}

#[test]
fn a_landing_is_named_by_the_axes_of_the_torso() {
    let mut world = World::new(Character::Standard, 200, 1.0).unwrap();
    let mut qpos = world.qpos().to_vec();
    let qvel = vec![0.0; world.nv()];
    let half = PI / 4.0;
    let about_y = |sign: f64| [half.cos(), 0.0, sign * half.sin(), 0.0];
    let about_x = |sign: f64| [half.cos(), sign * half.sin(), 0.0, 0.0];
    for (quaternion, landing) in [
        (about_y(-1.0), Landing::Supine),
        (about_y(1.0), Landing::Prone),
        (about_x(1.0), Landing::Lateral),
        (about_x(-1.0), Landing::Lateral),
    ] {
        qpos[3..7].copy_from_slice(&quaternion);
        world.set(&qpos, &qvel).unwrap();
        assert_eq!(Landing::of(&world).unwrap(), landing);
    }
}

#[test]
fn a_fall_depends_on_its_seed_alone_and_can_be_repeated_from_the_file() {
    let config = TaskConfig { character: Character::Cast, ..TaskConfig::default() };
    let many = falls::draw(&config, 6, 5).unwrap();
    let few = falls::draw(&config, 2, 5).unwrap();
    assert_eq!(few.falls, many.falls[..2]);

    let text = serde_json::to_string(&many).unwrap();
    let read: Falls = serde_json::from_str(&text).unwrap();
    assert_eq!(read, many);

    let fall = &read.falls[5];
    let mut lane = Lane::new(task(Character::Cast));
    lane.begin(fall.seed, 1.0);
    assert_eq!(lane.qpos(), fall.initial_qpos);
    let mut action = vec![0.0; lane.world().nu()];
    while lane.phase() == Phase::Limp {
        lane.limp_action(&mut action);
        lane.step(&action).unwrap();
    }
    assert_eq!((lane.qpos(), lane.qvel()), (&fall.qpos[..], &fall.qvel[..]));
}
