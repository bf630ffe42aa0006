use control_zones::{lockstep::in_process::InProcess, scenario};
use std::sync::Arc;
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let sets: Vec<scenario::Override> = args[2..].iter().map(|s| s.parse().unwrap()).collect();
    for seed in 1..=3u64 {
        let s = Arc::new(scenario::load(Some(&args[1]), &sets, Some(seed)).unwrap_or_else(|e| panic!("{e}")));
        let t = std::time::Instant::now();
        let mut run = InProcess::new(&s, 1, 1);
        run.run().unwrap();
        let e = t.elapsed();
        let w = run.world().summary();
        println!(
            "seed {seed} steps {} hash {:x} {:?}/step arrived {} departed {} held {} total {:.3}",
            w.steps,
            w.state_hash,
            e / w.steps as u32,
            w.arrived,
            w.departed,
            w.held_arrivals,
            w.zones.iter().map(|z| z.mean_objective).sum::<f64>()
        );
        for z in w.zones {
            println!(
                "  {} n {} t {:.3} e {:.3} J {:.3} fe {} {:.2}s inf {} rear {:?} merge {:?} clean {:?} {:?} ov {} {}",
                z.zone,
                z.vehicles,
                z.mean_time_s,
                z.mean_energy,
                z.mean_objective,
                z.fe_vehicles,
                z.fe_mean_s,
                z.infeasible_vehicles,
                z.min_rear_end_margin_m,
                z.min_merge_margin_m,
                z.min_rear_end_margin_clean_m,
                z.min_merge_margin_clean_m,
                z.order_violations,
                z.overtakes
            );
        }
    }
}
