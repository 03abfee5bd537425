//! Controllers combined: any of them trips, one law answers.

use crate::{
    Axes, DeviceModel, Fault, Observation, ParameterError,
    controller::{
        HandGraspController, PassivityController, VelocityForceController, WindowedSafetyController,
        cancel_and_damp, dampable,
    },
    observer::{
        HandGraspObserver, SafetyObserver, VelocityForceForm, VelocityForceObserver, WindowedSafetyObserver,
    },
    parameter::{in_range, non_negative, positive, whole},
};

/// Which controllers called the tick unsafe.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tripped(u8);

impl Tripped {
    /// Nobody.
    pub const NONE: Self = Self(0);
    /// VFC, Eq. 2.
    pub const VFC: Self = Self(1);
    /// HSC, Eq. 14.
    pub const HSC: Self = Self(2);
    /// WSC, Eq. 13.
    pub const WSC: Self = Self(4);
    /// PC, Eq. 12.
    pub const PC: Self = Self(8);
    /// No controller now, but its minimum time on or the release ramp has not ended.
    pub const HELD: Self = Self(16);

    /// Whether anything is set.
    pub fn any(self) -> bool {
        self.0 != 0
    }

    /// Whether all of `other` is set.
    pub fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// The bits, for records: VFC 1, HSC 2, WSC 4, PC 8, held 16.
    pub fn bits(self) -> u8 {
        self.0
    }

    fn with(self, other: Self, set: bool) -> Self {
        if set { Self(self.0 | other.0) } else { self }
    }
}

/// Which controllers watch, their thresholds, and how an intervention begins and ends.
///
/// A controller that is not asked for is not built, and an observer that no controller reads is not computed.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(clippy::struct_excessive_bools)] // four independent switches, each a controller
pub struct SafetySettings {
    /// Watch velocity and force (VFO, Eq. 1).
    pub vfc: bool,
    /// Watch the grasp (HGO, Eq. 5).
    pub hsc: bool,
    /// Watch the windowed energy (WSO, Eq. 11).
    pub wsc: bool,
    /// Dissipate missing energy (PC, Eq. 12).
    pub pc: bool,
    /// mu in N s/m, of Eq. 2, 13, 14.
    pub damping: f64,
    /// `V_t` in m/s, of Eq. 1.
    pub velocity_threshold: f64,
    /// `F_t` in N, of Eq. 1.
    pub vfc_force_threshold_n: f64,
    /// Which reading of Eq. 1.
    pub vfc_form: VelocityForceForm,
    /// zeta, of Eq. 8.
    pub grasp_threshold: f64,
    /// alpha in N, of Eq. 5.
    pub grasp_floor_n: f64,
    /// `F_t` in N, of Eq. 14.
    pub hsc_force_threshold_n: f64,
    /// delta in J, of Eq. 10.
    pub energy_threshold_j: f64,
    /// eta, of Eq. 9.
    pub energy_ratio: f64,
    /// w in ticks, of Eq. 11.
    pub window: usize,
    /// alpha in N s/m: bound on the damping of Eq. 12.
    pub pc_max_damping: f64,
    /// Least duration of an intervention in s.
    pub hold_off_s: f64,
    /// Time in s over which an intervention fades out; 0 gives the rendered force back as a step.
    pub release_ramp_s: f64,
}

impl Default for SafetySettings {
    /// The paper's thresholds (section 4), no controller, no hold-off, no ramp.
    fn default() -> Self {
        Self {
            vfc: false,
            hsc: false,
            wsc: false,
            pc: false,
            damping: 5.0,
            velocity_threshold: 0.6,
            vfc_force_threshold_n: 1.0,
            vfc_form: VelocityForceForm::Product,
            grasp_threshold: 1.5,
            grasp_floor_n: 1e-3,
            hsc_force_threshold_n: 0.1,
            energy_threshold_j: -0.03,
            energy_ratio: 0.5,
            window: 100,
            pc_max_damping: 10.0,
            hold_off_s: 0.0,
            release_ramp_s: 0.0,
        }
    }
}

/// What the safety controllers add at one tick, and what they saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intervention<const N: usize> {
    /// `F_c` in N.
    pub safety_force: Axes<N>,
    /// Who tripped.
    pub tripped: Tripped,
    /// `S_vf`; NaN when VFC is not built.
    pub velocity_force: f64,
    /// `S_h`; NaN when HSC is not built.
    pub grasp: f64,
    /// `E_wso` in J; NaN when WSC is not built.
    pub windowed_energy_j: f64,
    /// `E_so` in J; NaN when PC is not built.
    pub energy_j: f64,
}

impl<const N: usize> Intervention<N> {
    /// No force, and nothing was observed.
    pub fn none() -> Self {
        Self {
            safety_force: Axes::zeros(),
            tripped: Tripped::NONE,
            velocity_force: f64::NAN,
            grasp: f64::NAN,
            windowed_energy_j: f64::NAN,
            energy_j: f64::NAN,
        }
    }
}

/// Controllers combined by "any of".
///
/// While one of VFC, HSC, WSC trips, `F_c = -F_v - mu V`. It stays so for at least the hold-off, then fades over
/// the release ramp: `F_c = g (-F_v - mu V)` with `g = 1 - s²`, s from 0 to 1. A new trip sets g to 1 at once. PC adds its own
/// force in the share 1 - g that the intervention leaves.
///
/// Source: paper Eq. 2, 12, 13, 14.
#[derive(Clone, Debug, PartialEq)]
pub struct SafetyController<const N: usize> {
    vfc: Option<VelocityForceController>,
    hsc: Option<HandGraspController>,
    wsc: Option<WindowedSafetyController<N>>,
    pc: Option<PassivityController<N>>,
    damping: f64,
    hold_off_ticks: u64,
    ramp_ticks: u64,
    /// Ticks since the current intervention began; none is on when `None`.
    on_for: Option<u64>,
    /// Ticks since the intervention began to fade.
    fading_for: u64,
    /// Share of `F_v` that the last tick let through.
    let_through: f64,
}

impl<const N: usize> SafetyController<N> {
    /// Longest hold-off or ramp in s.
    pub const MAX_HOLD_S: f64 = 60.0;

    /// Builds what `settings` asks for, for a device sampled every `period_s`.
    pub fn new(
        device: &DeviceModel<N>,
        period_s: f64,
        settings: &SafetySettings,
    ) -> Result<Self, ParameterError> {
        let period_s = positive("period_s", "dT", period_s)?;
        let ticks = |name, value| {
            let value = in_range(name, "time", value, 0.0, Self::MAX_HOLD_S, "between 0 and 60 s")?;
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // 0 to 60 s of ticks fit
            Ok((value / period_s).round() as u64)
        };
        let SafetySettings { energy_ratio, window, .. } = *settings;
        let named = |name| move |error: ParameterError| error.of_field("force_threshold_n", name);
        // All are checked, also those that are not asked for: a wrong number is wrong before it is needed.
        let vfc = VelocityForceObserver::new(
            settings.velocity_threshold,
            settings.vfc_force_threshold_n,
            settings.vfc_form,
        )
        .map_err(named("vfc_force_threshold_n"))?;
        let hsc = HandGraspController::new(
            HandGraspObserver::new(settings.grasp_floor_n)?,
            settings.grasp_threshold,
            settings.hsc_force_threshold_n,
        )
        .map_err(named("hsc_force_threshold_n"))?;
        whole("window", "w", window, 1, WindowedSafetyObserver::<N>::MAX_WINDOW, "1 to 3600000 ticks")?;
        // A window that nobody reads is not reserved.
        let window = if settings.wsc { window } else { 1 };
        let wso = WindowedSafetyObserver::new(*device, period_s, energy_ratio, window)?;
        let wsc = WindowedSafetyController::new(wso, settings.energy_threshold_j)?;
        let so = SafetyObserver::new(*device, period_s, energy_ratio)?;
        // How much damping a device stands is asked only where it is applied: the defaults suit a stylus at 1 kHz.
        let stands = |is_used, name, symbol, value| {
            if is_used {
                dampable(name, symbol, value, device, period_s)
            } else {
                non_negative(name, symbol, value)
            }
        };
        let alpha = stands(settings.pc, "pc_max_damping", "alpha", settings.pc_max_damping)?;
        let pc = PassivityController::new(so, device, period_s, if settings.pc { alpha } else { 0.0 })?;
        let damps = settings.vfc || settings.hsc || settings.wsc;
        let damping = stands(damps, "damping", "mu", settings.damping)?;
        Ok(Self {
            vfc: settings.vfc.then(|| VelocityForceController::new(vfc)),
            hsc: settings.hsc.then_some(hsc),
            wsc: settings.wsc.then_some(wsc),
            pc: settings.pc.then_some(pc),
            damping,
            hold_off_ticks: ticks("hold_off_s", settings.hold_off_s)?,
            ramp_ticks: ticks("release_ramp_s", settings.release_ramp_s)?,
            on_for: None,
            fading_for: 0,
            let_through: 1.0,
        })
    }

    /// `F_c` for this tick. A sample that is not finite or absurd changes no state and is returned as a fault.
    pub fn step(&mut self, seen: &Observation<N>) -> Result<Intervention<N>, Fault> {
        self.step_with_authority(seen, 1.0)
    }

    /// As [`step`](Self::step), with damping in the share `authority` (0 to 1) only.
    ///
    /// Cancelling `F_v` needs no authority, for it takes a force away. Damping is a force: without a peer it goes as
    /// the rendered force goes.
    pub fn step_with_authority(
        &mut self,
        seen: &Observation<N>,
        authority: f64,
    ) -> Result<Intervention<N>, Fault> {
        seen.check()?;
        let (velocity_force, vfc) = self.vfc.map_or((f64::NAN, false), |vfc| vfc.judge(seen));
        let (grasp, hsc) = self.hsc.map_or((f64::NAN, false), |hsc| hsc.judge(&self.felt(seen)));
        let (windowed_energy_j, wsc) = self.wsc.as_mut().map_or((f64::NAN, false), |wsc| wsc.step(seen));
        let pc = self.pc.as_mut().map(|pc| pc.step(seen));

        let is_unsafe = vfc || hsc || wsc;
        let gain = self.gain(is_unsafe);
        self.let_through = 1.0 - gain;
        let mut safety_force = cancel_and_damp(seen, self.damping * authority) * gain;
        let mut tripped = Tripped::NONE
            .with(Tripped::VFC, vfc)
            .with(Tripped::HSC, hsc)
            .with(Tripped::WSC, wsc)
            .with(Tripped::HELD, gain > 0.0 && !is_unsafe);
        if gain == 0.0 {
            safety_force = Axes::zeros(); // not -0.0: records stay clean
        }
        if let Some(action) = pc
            && gain < 1.0
            && action.force != Axes::<N>::zeros()
        {
            safety_force += action.force * ((1.0 - gain) * authority);
            tripped = tripped.with(Tripped::PC, true);
        }
        let energy_j = pc.map_or(f64::NAN, |action| action.energy_j);
        Ok(Intervention { safety_force, tripped, velocity_force, grasp, windowed_energy_j, energy_j })
    }

    /// What a hand can have felt of `F_v`, for HSC with a release ramp.
    ///
    /// While an intervention cancels `F_v`, a hand has nothing to hold against: against all of `F_v`, `S_h` would stay
    /// large for ever and the hand that has come back would never get its force again. So the force comes back over
    /// the ramp, and `S_h` compares the hand with the share that is rendered: one that holds ends the intervention, one
    /// that is gone trips it anew as soon as that share exceeds `F_t`. Without a ramp, Eq. 14 stands as printed.
    fn felt(&self, seen: &Observation<N>) -> Observation<N> {
        let share = if self.ramp_ticks > 0 && self.on_for.is_some() { self.let_through } else { 1.0 };
        Observation { aligned_rendered_force: seen.aligned_rendered_force * share, ..*seen }
    }

    /// Share of the intervention that is on at this tick.
    fn gain(&mut self, is_unsafe: bool) -> f64 {
        if is_unsafe {
            let on_for = if self.fading_for > 0 { 0 } else { self.on_for.unwrap_or(0) };
            (self.on_for, self.fading_for) = (Some(on_for.saturating_add(1)), 0);
            return 1.0;
        }
        let Some(on_for) = self.on_for else { return 0.0 };
        if on_for < self.hold_off_ticks {
            self.on_for = Some(on_for + 1);
            return 1.0;
        }
        self.fading_for += 1;
        if self.fading_for > self.ramp_ticks {
            (self.on_for, self.fading_for) = (None, 0);
            return 0.0;
        }
        // Slowly at first: a hand needs some 50 ms to take up a load, and one that is still taking it up looks gone.
        let share = self.fading_for as f64 / (self.ramp_ticks + 1) as f64;
        1.0 - share * share
    }

    /// Which of `S_vf`, `S_h`, `E_wso`, `E_so` are observed.
    pub fn observed(&self) -> [bool; 4] {
        [self.vfc.is_some(), self.hsc.is_some(), self.wsc.is_some(), self.pc.is_some()]
    }

    /// Whether a controller reads the grasp force.
    pub fn needs_grasp_force(&self) -> bool {
        self.hsc.is_some() || self.wsc.is_some() || self.pc.is_some()
    }

    /// Energy in J that PC asked for and the force `delivered` beyond `F_v` did not dissipate; 0 without PC.
    pub fn owed_energy_j(
        &self,
        intervention: &Intervention<N>,
        delivered: &Axes<N>,
        velocity: &Axes<N>,
    ) -> f64 {
        self.pc.as_ref().map_or(0.0, |pc| pc.owed_energy_j(intervention.energy_j, delivered, velocity))
    }

    /// Forgets all energy and ends any intervention.
    pub fn reset(&mut self) {
        if let Some(wsc) = self.wsc.as_mut() {
            wsc.reset();
        }
        if let Some(pc) = self.pc.as_mut() {
            pc.reset();
        }
        (self.on_for, self.fading_for, self.let_through) = (None, 0, 1.0);
    }
}
