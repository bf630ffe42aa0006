//! How the runtime's choices are written on the command line.

use crate::process::{OnMiss, Pace, Placement, RecordLag, WaitMode};
use clap::ValueEnum;
use clap::builder::PossibleValue;

/// The values of an enum, each with its word and what it means.
macro_rules! choices {
    ($($choice:ty { $($value:ident = $word:literal, $help:literal;)+ })+) => {$(
        impl ValueEnum for $choice {
            fn value_variants<'a>() -> &'a [Self] {
                &[$(Self::$value),+]
            }

            fn to_possible_value(&self) -> Option<PossibleValue> {
                Some(match self {
                    $(Self::$value => PossibleValue::new($word).help($help),)+
                })
            }
        }
    )+};
}

choices! {
    WaitMode {
        Adaptive = "adaptive", "World and controllers spin while that pays and sleep otherwise; coordinators sleep from event to event";
        Hybrid = "hybrid", "World and controllers spin, then yield; coordinators sleep from event to event";
        Spin = "spin", "Everyone spins; needs a core for each process";
        Block = "block", "Everyone sleeps until rung";
    }
    Placement {
        None = "none", "Wherever the system puts them";
        Auto = "auto", "The world on the first core; controllers on the others in turn, then on the first too; coordinators with the controllers";
    }
    Pace {
        Free = "free", "Each as soon as the one before is done";
        Realtime = "realtime", "Step k at k times the step length after the first";
    }
    OnMiss {
        Wait = "wait", "The world waits, and makes up for lost time afterwards";
        Hold = "hold", "The world goes on; the vehicles hold their accelerations";
        ShieldFallback = "shield-fallback", "The world goes on; the vehicles hold their accelerations as far as the shield allows";
        Abort = "abort", "The run ends";
    }
    RecordLag {
        Drop = "drop", "It is left out of the recording, which says so; the run keeps its time";
        Wait = "wait", "The run waits; the recording is whole";
    }
}
