//! When a diagnosis is told to those who look, to recording and telemetry: live and in virtual time the same.

use super::Diagnosis;

/// A diagnosis is reported once it has stood for this long in ns: the text of a peer arrives in pieces.
const SETTLED_NS: u64 = 50_000_000;

/// Why the two sides are not coupled, and whether that was reported.
pub(crate) struct DiagnosisReport {
    newest: Option<Diagnosis>,
    since_ns: u64,
    is_reported: bool,
    /// Whether recording and telemetry have it: they do not wait for those who look.
    is_noted: bool,
}

impl DiagnosisReport {
    /// Nothing stands since `start_ns`.
    pub(crate) fn new(start_ns: u64) -> Self {
        Self { newest: None, since_ns: start_ns, is_reported: true, is_noted: true }
    }

    /// Takes the newest of a run in virtual time, and returns it once it has stood for long enough; at the end at once.
    pub(crate) fn settled(
        &mut self,
        now_ns: u64,
        newest: Option<&Diagnosis>,
        is_end: bool,
    ) -> Option<Diagnosis> {
        let is_due = self.is_due(now_ns, newest) || (is_end && !self.is_reported);
        self.is_reported |= is_due;
        self.newest.filter(|_| is_due)
    }

    /// Takes the newest; whether it is still to be reported.
    pub(crate) fn is_unreported(&mut self, newest: Option<&Diagnosis>) -> bool {
        if self.newest.as_ref() != newest {
            (self.newest, self.is_reported, self.is_noted) = (newest.copied(), false, false);
        }
        !self.is_reported
    }

    /// Takes the newest; whether it has stood for long enough, and is still to be reported.
    pub(crate) fn is_due(&mut self, now_ns: u64, newest: Option<&Diagnosis>) -> bool {
        // More text on the same case, or a link that comes and goes, do not put off what was not reported yet.
        let is_same_case = |before: &Diagnosis| newest.is_some_and(|newest| before.is_same_case(newest));
        if self.newest.as_ref() != newest
            && (self.is_reported || !self.newest.as_ref().is_some_and(is_same_case))
        {
            self.since_ns = now_ns;
        }
        self.is_unreported(newest) && now_ns.saturating_sub(self.since_ns) >= SETTLED_NS
    }

    /// Reports it: `take` says whether whoever looks has room for it, and is asked again at the next tick where not;
    /// `note` has it once.
    pub(crate) fn report(
        &mut self,
        take: impl FnOnce(Option<Diagnosis>) -> bool,
        note: impl FnOnce(Option<&Diagnosis>),
    ) {
        self.is_reported = take(self.newest);
        if !std::mem::replace(&mut self.is_noted, true) {
            note(self.newest.as_ref());
        }
    }
}
