#[test]
fn quick_timing() {
    use crate::config::*; use crate::sac::*;
    for (network, batch, threads) in [(NetworkKind::Simba, 128, 1), (NetworkKind::Simba, 128, 2), (NetworkKind::Simba, 256, 1), (NetworkKind::Mlp, 256, 1)] {
        for precision in [Precision::Bf16, Precision::Fp32] {
        let config = SacConfig { network, hidden: vec![256,256], critics: if network == NetworkKind::Simba {1} else {2}, precision, normalize_observations: true, ..SacConfig::default() };
        let shape = TaskShape { observation: 68, action: 21, unnormalized: vec![67] };
        let mut sac = Sac::new(&shape, &config, 5, tch::Device::Cpu, threads);
        let col = |n: usize| (0..batch*n).map(|i| ((i as f32)*0.7).sin()).collect::<Vec<f32>>();
        let b = Batch { observation: col(68), next_observation: col(68), action: col(21), reward: col(1), discount: vec![0.9; batch], beta: vec![1.0; batch] };
        for _ in 0..20 { sac.update(&b).unwrap(); }
        let mut best = f64::MAX;
        for _ in 0..5 { let t = std::time::Instant::now(); for _ in 0..100 { sac.update(&b).unwrap(); } best = best.min(t.elapsed().as_secs_f64()/100.0); }
        println!("{network:?} {batch} threads {threads} {precision:?}: {:.0}/s", 1.0/best);
        }
    }
}
