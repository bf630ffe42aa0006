//! `cz plan`: one reference trajectory.

use super::args::PlanArgs;
use super::{AppError, print};
use crate::control::Terminal;
use crate::control::reference::Problem;
use crate::scenario::ReferenceLaw;

pub(super) fn plan(args: &PlanArgs) -> Result<(), AppError> {
    check("--v0", args.v0, (0.0..=1e3).contains(&args.v0), "a speed from 0 to 1000 m/s")?;
    check("--length", args.length, args.length > 0.0 && args.length <= 1e6, "a length > 0 and <= 1e6 m")?;
    check("--beta", args.beta, args.beta > 0.0 && args.beta <= 1e6, "a weight > 0 and <= 1e6 m^2/s^4")?;
    let terminal = match args.vm {
        Some(vm) => {
            check("--vm", vm, (0.0..=1e3).contains(&vm), "a speed from 0 to 1000 m/s")?;
            Terminal::Speed(vm)
        }
        None => Terminal::Free,
    };
    let law = if args.as_printed { ReferenceLaw::AsPrinted } else { ReferenceLaw::Corrected };
    let problem = Problem { beta: args.beta, v0_mps: args.v0, length_m: args.length, terminal };
    let optimum = problem.solve(law);
    let (t, a, b, c) = (optimum.duration_s, optimum.a, optimum.b, args.v0);
    let cost = optimum.cost(args.beta);
    let terminal_mps = c + (b + 0.5 * a * t) * t;
    if args.json {
        let json = serde_json::json!({
            "T": t, "a": a, "b": b, "c": c, "cost": cost,
            "terminal_speed_mps": terminal_mps, "energy": optimum.energy(),
        });
        return print(&format!("{json}\n"));
    }
    print(&format!(
        "T     {t:.9} s\na     {a:.9} m/s^3\nb     {b:.9} m/s^2\nc     {c:.9} m/s\ncost  {cost:.9} \
         (beta T + energy {:.9})\nv(T)  {terminal_mps:.9} m/s\n",
        optimum.energy()
    ))
}

fn check(name: &str, value: f64, valid: bool, expected: &str) -> Result<(), AppError> {
    if valid { Ok(()) } else { Err(AppError::Usage(format!("{name} {value}: expected {expected}"))) }
}
