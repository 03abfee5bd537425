//! The free motion of a damped oscillator.

/// `y'' + c y' + k y = 0`, solved in closed form.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Transition {
    k: f64,
    /// c / 2
    half: f64,
    /// (c / 2)² - k: positive if overdamped.
    discriminant: f64,
}

impl Transition {
    /// k in 1/s² (> 0), c in 1/s (>= 0).
    pub(crate) fn new(k: f64, c: f64) -> Self {
        let half = 0.5 * c;
        Self { k, half, discriminant: half * half - k }
    }

    /// (y, y') after t in s.
    pub(crate) fn apply(&self, t: f64, [y, v]: [f64; 2]) -> [f64; 2] {
        let Self { k, half, discriminant } = *self;
        let z = discriminant * t * t;
        if z > 1e-2 {
            let root = discriminant.sqrt();
            // The slow pole by the product of both: no difference of nearly equal numbers.
            let (slow, fast) = (-k / (half + root), -(half + root));
            let (e_slow, e_fast) = ((slow * t).exp(), (fast * t).exp());
            let sine = (e_slow - e_fast) / (2.0 * root);
            let from_y = (slow * e_fast - fast * e_slow) / (2.0 * root);
            let from_v = (slow * e_slow - fast * e_fast) / (2.0 * root);
            return [y * from_y + v * sine, v * from_v - k * y * sine];
        }
        let decay = (-half * t).exp();
        let (cosine, sine) = if z < -1e-2 {
            let rate = (-discriminant).sqrt();
            let (sin, cos) = (rate * t).sin_cos();
            (cos, sin / rate)
        } else {
            // Near critical damping both are power series of z; z^6 / 12! is below rounding.
            let mut cosine = 0.0;
            let mut sine = 0.0;
            for n in (0..6_u32).rev() {
                let m = f64::from(2 * n);
                cosine = 1.0 + cosine * z / ((m + 1.0) * (m + 2.0));
                sine = 1.0 + sine * z / ((m + 2.0) * (m + 3.0));
            }
            (cosine, sine * t)
        };
        let (cosine, sine) = (decay * cosine, decay * sine);
        [y * (cosine + half * sine) + v * sine, v * (cosine - half * sine) - k * y * sine]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix2, Vector2};

    #[test]
    fn it_is_the_matrix_exponential() {
        for (k, c) in
            [(9.0, 0.0), (9.0, 1.0), (9.0, 5.999), (9.0, 6.0), (9.0, 6.001), (9.0, 40.0), (1.0, 0.0)]
        {
            for t in [1e-4, 0.01, 0.3, 1.0] {
                let exact = (Matrix2::new(0.0, 1.0, -k, -c) * t).exp() * Vector2::new(0.7, -1.3);
                let [y, v] = Transition::new(k, c).apply(t, [0.7, -1.3]);
                // A few tens of roundings in the scaled and squared exponential.
                assert!(
                    (y - exact.x).abs() < 2e-14 && (v - exact.y).abs() < 1e-13,
                    "{k} {c} {t}: {y} {v} {exact}"
                );
            }
        }
    }
}
