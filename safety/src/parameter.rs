//! Check of parameters, with one error type for all parts of this crate.

use thiserror::Error;

/// Parameter outside the range of its equation.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("{name} ({symbol}) = {seen}: must be {allowed}")]
pub struct ParameterError {
    /// Field name, as the caller wrote it.
    pub name: &'static str,
    /// Symbol in the equation.
    pub symbol: &'static str,
    /// Refused value.
    pub seen: f64,
    /// Allowed values.
    pub allowed: &'static str,
}

impl ParameterError {
    /// Rename the field of the error from `name` to the name in the caller's settings.
    pub(crate) fn of_field(self, name: &str, known_as: &'static str) -> Self {
        if self.name == name { Self { name: known_as, ..self } } else { self }
    }
}

/// Check that a value is finite and above zero.
pub(crate) fn positive(name: &'static str, symbol: &'static str, value: f64) -> Result<f64, ParameterError> {
    let allowed = "finite and above 0";
    check(name, symbol, value, value.is_finite() && value > 0.0, allowed)
}

/// Check that a value is finite and zero or more.
pub(crate) fn non_negative(
    name: &'static str,
    symbol: &'static str,
    value: f64,
) -> Result<f64, ParameterError> {
    let allowed = "finite and 0 or more";
    check(name, symbol, value, value.is_finite() && value >= 0.0, allowed)
}

/// Check that a value lies in the closed interval from `low` to `high`; `allowed` describes the interval.
pub(crate) fn in_range(
    name: &'static str,
    symbol: &'static str,
    value: f64,
    low: f64,
    high: f64,
    allowed: &'static str,
) -> Result<f64, ParameterError> {
    // With an infinite bound, the comparison alone would accept infinity.
    let inside = value.is_finite() && value >= low && value <= high;
    check(name, symbol, value, inside, allowed)
}

/// Check that a value is finite.
pub(crate) fn finite(name: &'static str, symbol: &'static str, value: f64) -> Result<f64, ParameterError> {
    check(name, symbol, value, value.is_finite(), "finite")
}

/// Check that a value is above 0 and at most 1.
pub(crate) fn ratio(name: &'static str, symbol: &'static str, value: f64) -> Result<f64, ParameterError> {
    check(name, symbol, value, value > 0.0 && value <= 1.0, "above 0 and at most 1")
}

/// Check that a count lies between `low` and `high`; `allowed` describes the interval.
pub(crate) fn integer_in_range(
    name: &'static str,
    symbol: &'static str,
    count: usize,
    low: usize,
    high: usize,
    allowed: &'static str,
) -> Result<usize, ParameterError> {
    check(name, symbol, count as f64, (low..=high).contains(&count), allowed).map(|_| count)
}

fn check(
    name: &'static str,
    symbol: &'static str,
    seen: f64,
    accepted: bool,
    allowed: &'static str,
) -> Result<f64, ParameterError> {
    if accepted { Ok(seen) } else { Err(ParameterError { name, symbol, seen, allowed }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_match_the_function_names() {
        assert_eq!(positive("mass_kg", "m", 0.1), Ok(0.1));
        assert!(positive("mass_kg", "m", 0.0).is_err());
        assert_eq!(non_negative("viscous", "b", 0.0), Ok(0.0));
        assert!(non_negative("viscous", "b", -1e-300).is_err());
        assert_eq!(in_range("degree", "d", 3.0, 2.0, 3.0, "2 or 3"), Ok(3.0));
        assert!(in_range("degree", "d", 3.1, 2.0, 3.0, "2 or 3").is_err());
        assert!(in_range("degree", "d", 1.9, 2.0, 3.0, "2 or 3").is_err());
    }

    #[test]
    fn non_finite_values_are_refused() {
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert!(positive("mass_kg", "m", value).is_err());
            assert!(non_negative("viscous", "b", value).is_err());
            assert!(in_range("mass_kg", "m", value, f64::NEG_INFINITY, f64::INFINITY, "finite").is_err());
        }
    }

    #[test]
    fn intervals_match_the_function_names() {
        assert_eq!(finite("viscous", "b", -1e300), Ok(-1e300));
        assert_eq!(ratio("gain", "k", 1.0), Ok(1.0));
        for value in [0.0, -0.1, 1.0 + f64::EPSILON, f64::NAN] {
            assert!(ratio("gain", "k", value).is_err());
        }
        for (count, accepted) in [(1, false), (2, true), (3, true), (4, false)] {
            assert_eq!(integer_in_range("window", "n", count, 2, 3, "2 or 3").is_ok(), accepted);
        }
        assert_eq!(integer_in_range("window", "n", 3, 2, 3, "2 or 3"), Ok(3));
        for value in [f64::NAN, f64::INFINITY] {
            assert!(finite("viscous", "b", value).is_err());
        }
    }

    #[test]
    fn an_error_is_renamed_for_its_field_only() {
        let error = ParameterError { name: "threshold", symbol: "t", seen: 2.0, allowed: "1" };
        assert_eq!(error.clone().of_field("window", "other"), error);
        assert_eq!(error.clone().of_field("threshold", "other"), ParameterError { name: "other", ..error });
    }

    #[test]
    fn the_message_names_field_symbol_value_and_bound() {
        let refused = positive("mass_kg", "m", -1.0).map_err(|error| error.to_string());
        assert_eq!(refused, Err("mass_kg (m) = -1: must be finite and above 0".to_owned()));
    }
}
