//! Other rules for a proxy that runs.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use crate::link::{Link, Rules};
use crate::settings::{LinkError, LinkSettings};
use crate::verdict::Direction;

/// A handle by which any thread gives a running proxy other rules.
#[derive(Clone, Debug)]
pub struct ProxyControl {
    pub(super) seed: u64,
    pub(super) forward: Arc<Change>,
    pub(super) backward: Arc<Change>,
}

impl ProxyControl {
    /// Other settings for the datagrams that come from now on; those under way arrive as was settled.
    ///
    /// They are checked and built on the caller's thread; the proxy takes them up when it next wakes, within 20 ms.
    /// What was asked for before and not yet taken up is forgotten.
    pub fn change(&self, direction: Direction, settings: &LinkSettings) -> Result<(), LinkError> {
        self.change_rules(direction, Rules::build(direction, self.seed, settings)?);
        Ok(())
    }

    pub(crate) fn change_rules(&self, direction: Direction, rules: Rules) {
        let change = match direction {
            Direction::Forward => &self.forward,
            Direction::Backward => &self.backward,
        };
        change.ask(rules);
    }
}

/// Rules that wait to be taken up; afterwards, those that were replaced, so that the proxy's thread frees nothing.
#[derive(Debug, Default)]
pub(super) struct Change {
    is_waiting: AtomicBool,
    rules: Mutex<Option<Rules>>,
}

impl Change {
    fn ask(&self, rules: Rules) {
        let replaced = {
            let mut slot = self.rules.lock().unwrap_or_else(PoisonError::into_inner);
            let replaced = slot.replace(rules);
            self.is_waiting.store(true, Ordering::Release);
            replaced
        };
        drop(replaced);
    }

    /// Takes waiting rules up, unless somebody is just bringing others: then the next time.
    pub(super) fn take_up(&self, link: &mut Link) {
        if !self.is_waiting.load(Ordering::Acquire) {
            return;
        }
        if let Ok(mut slot) = self.rules.try_lock()
            && let Some(rules) = slot.as_mut()
        {
            link.swap(rules);
            self.is_waiting.store(false, Ordering::Release);
        }
    }
}
