//! Means with 95 % intervals, and the quadratic fit of the sweep.
//!
//! The Student quantile comes from `statrs` without its default features: a dozen lines of table would
//! do for the default number of seeds, but `--seeds` takes any.

use nalgebra::{Matrix3, Vector3};
use serde::Serialize;
use statrs::distribution::{ContinuousCDF, StudentsT};

/// A mean over independent replicates with its 95 % confidence interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Interval {
    /// Mean.
    pub mean: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    /// Replicates.
    pub n: usize,
}

impl Interval {
    /// The Student-t interval of the mean; `None` with fewer than two values or one that is not finite.
    ///
    /// Differences between policies are taken within a replicate, on the same arrivals, before they come
    /// here: the interval of paired differences.
    pub fn of(values: &[f64]) -> Option<Interval> {
        let n = values.len();
        if n < 2 || values.iter().any(|v| !v.is_finite()) {
            return None;
        }
        let mean = values.iter().sum::<f64>() / n as f64;
        let variance = values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / (n - 1) as f64;
        let half = student_975(n - 1) * (variance / n as f64).sqrt();
        Some(Interval { mean, low: mean - half, high: mean + half, n })
    }

    /// Half the width of the interval.
    pub fn half_width(&self) -> f64 {
        0.5 * (self.high - self.low)
    }

    /// Whether the interval and `[low, high]` have a point in common.
    pub fn meets(&self, low: f64, high: f64) -> bool {
        self.low <= high && self.high >= low
    }
}

/// The 97.5 % quantile of Student's t with that many degrees of freedom (at least 1).
pub fn student_975(degrees: usize) -> f64 {
    StudentsT::new(0.0, 1.0, degrees.max(1) as f64)
        .expect("location and scale are constants, degrees of freedom positive")
        .inverse_cdf(0.975)
}

/// `c0 + c1 x + c2 x^2`, fitted by least squares.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Quadratic {
    /// Coefficients, constant first.
    pub coefficients: [f64; 3],
    /// Share of the variance explained.
    pub r_squared: f64,
}

impl Quadratic {
    /// Fits the points; `None` with fewer than four or when they do not determine the fit.
    pub fn fit(x: &[f64], y: &[f64]) -> Option<Quadratic> {
        if x.len() < 4 || x.len() != y.len() {
            return None;
        }
        // Around the mean the normal equations of so short a polynomial are well conditioned.
        let centre = x.iter().sum::<f64>() / x.len() as f64;
        let mut normal = Matrix3::<f64>::zeros();
        let mut right = Vector3::<f64>::zeros();
        for (&x, &y) in x.iter().zip(y) {
            let row = Vector3::new(1.0, x - centre, (x - centre) * (x - centre));
            normal += row * row.transpose();
            right += row * y;
        }
        let c = normal.cholesky()?.solve(&right);
        let coefficients = [c[0] - c[1] * centre + c[2] * centre * centre, c[1] - 2.0 * c[2] * centre, c[2]];
        let mean = y.iter().sum::<f64>() / y.len() as f64;
        let value = |x: f64| c[0] + (c[1] + c[2] * (x - centre)) * (x - centre);
        let rest: f64 = x.iter().zip(y).map(|(&x, &y)| (y - value(x)) * (y - value(x))).sum();
        let all: f64 = y.iter().map(|&y| (y - mean) * (y - mean)).sum();
        Some(Quadratic { coefficients, r_squared: if all > 0.0 { 1.0 - rest / all } else { 1.0 } })
    }

    /// Value at `x`.
    pub fn value(&self, x: f64) -> f64 {
        let [c0, c1, c2] = self.coefficients;
        c0 + (c1 + c2 * x) * x
    }

    /// Where it is least; `None` when it has no minimum.
    pub fn minimum(&self) -> Option<f64> {
        let [_, c1, c2] = self.coefficients;
        (c2 > 0.0).then(|| -c1 / (2.0 * c2))
    }
}

/// Slope of the least-squares line through the points.
pub fn slope(x: &[f64], y: &[f64]) -> f64 {
    let n = x.len() as f64;
    let (mx, my) = (x.iter().sum::<f64>() / n, y.iter().sum::<f64>() / n);
    let cross: f64 = x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum();
    let own: f64 = x.iter().map(|x| (x - mx) * (x - mx)).sum();
    cross / own
}
