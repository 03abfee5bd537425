//! Timing of diagnosis reports: to the caller, to recording and to telemetry, live and in virtual time alike.

use super::Diagnosis;

/// Time in ns that a diagnosis must last before it is reported, because the text of a peer arrives in pieces.
const SETTLED_NS: u64 = 50_000_000;

/// Newest diagnosis, and whether it was reported.
pub(crate) struct DiagnosisReport {
    newest: Option<Diagnosis>,
    since_ns: u64,
    is_reported: bool,
    /// True if recording and telemetry have the newest diagnosis. They get it once, even if the caller's
    /// queue is full.
    is_noted: bool,
}

impl DiagnosisReport {
    /// Start at `start_ns` without a diagnosis.
    pub(crate) fn new(start_ns: u64) -> Self {
        Self { newest: None, since_ns: start_ns, is_reported: true, is_noted: true }
    }

    /// Take the newest diagnosis of a virtual-time run. Returns it one time: after it has lasted long enough,
    /// or at the end of the run (`is_end`).
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

    /// Take the newest diagnosis; return whether it is still to be reported.
    pub(crate) fn is_unreported(&mut self, newest: Option<&Diagnosis>) -> bool {
        if self.newest.as_ref() != newest {
            (self.newest, self.is_reported, self.is_noted) = (newest.copied(), false, false);
        }
        !self.is_reported
    }

    /// Take the newest diagnosis; return whether it has lasted long enough and is still to be reported.
    pub(crate) fn is_due(&mut self, now_ns: u64, newest: Option<&Diagnosis>) -> bool {
        // More text on the same case, or an intermittent link, must not delay a pending report.
        let is_same_case = |before: &Diagnosis| newest.is_some_and(|newest| before.is_same_case(newest));
        if self.newest.as_ref() != newest
            && (self.is_reported || !self.newest.as_ref().is_some_and(is_same_case))
        {
            self.since_ns = now_ns;
        }
        self.is_unreported(newest) && now_ns.saturating_sub(self.since_ns) >= SETTLED_NS
    }

    /// Report the diagnosis. `take` returns whether the caller's queue had room; if not, the diagnosis stays
    /// unreported. `note` gets each diagnosis once.
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
