use std::time::Instant;
use haptether_bridge::scene::*;
fn main(){
    let scene = std::fs::read("/tmp/wu.json").unwrap();
    for n in [1usize, 10000] { for lanes in [true,false] {
        let values: Vec<f64> = (0..n).map(|i| -(0.01+0.05*(i as f64)/(((n-1).max(1)) as f64))).collect();
        let v=[Variation{path:"operator.legs.0.end.0".into(), values}];
        let mut best=f64::MAX; let mut s=(0.0,0);
        for _ in 0..5 { let t=Instant::now(); let o=sweep(&scene,&v,SweepSettings{threads:1,lanes}).unwrap(); best=best.min(t.elapsed().as_secs_f64());
        s=(o.iter().map(|o|o.max_ejection_velocity).sum(), o.iter().map(|o|o.intervention_ticks).sum::<u64>()); }
        println!("{n} {lanes} {:.2} ns {:.9} {}", best*1e9/(n as f64)/2000.0, s.0, s.1);
    }}
}
