//! The answer of a diagnosis, in the shape of the contract's report.

use serde::{Deserialize, Serialize};

use super::input::Mode;
use crate::diagnosis::effects::effect::{Effect, Family};

/// Where the noise floor comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoiseSource {
    /// Runs with the same drive.
    Repeats,
    /// Runs or periods with the same drive that were found among the runs.
    FoundRepeats,
    /// No repeats: what the best predictor leaves of runs that it has not seen bounds the noise from above.
    Bounded,
    /// What the core leaves of the baseline runs, from before the change; the verdict is capped.
    Assumed,
}

/// What kind of answer this is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "the contract's own words")]
pub enum VerdictKind {
    Identified,
    Partial,
    FamilyOnly,
    NotDistinguishable,
    NoneOfCatalogue,
    Undecided,
    NoiseOrUnmeasuredDisturbance,
    NoMaterialGap,
}

impl VerdictKind {
    /// Whether the verdict blames something of the rig that a model could have.
    pub fn blames(self) -> bool {
        matches!(self, Self::Identified | Self::Partial | Self::FamilyOnly | Self::NotDistinguishable)
    }
}

/// The answer in one sentence's worth of fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// What kind of answer.
    pub kind: VerdictKind,
    /// The effect blamed, if one is.
    pub effect: Option<Effect>,
    /// Its family.
    pub family: Option<Family>,
    /// Axis of the effect.
    pub axis: Option<String>,
    /// Channel at which it acts.
    #[serde(default)]
    pub at: Option<String>,
    /// Or the two channels between which it acts.
    #[serde(default)]
    pub between: Option<[String; 2]>,
    /// Response on which it closes most.
    pub channel: Option<String>,
    /// The answer in one sentence; empty where it is made by the page alone.
    #[serde(default)]
    pub in_words: String,
    /// That this verdict is right, 0..1.
    pub probability: f64,
    /// Effects that these runs cannot tell apart, the blamed one first.
    pub equivalence_set: Vec<Effect>,
    /// What is blamed, the first effect and those beside it that close more than its equation may err by; empty where none
    /// is named.
    #[serde(default)]
    pub effects: Vec<EffectShare>,
    /// Reasons, in words.
    pub because: Vec<String>,
}

/// Size of the gap.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Gap {
    /// Systematic RMS relative to the response's, in band, on the select runs; largest response.
    pub systematic_rms_rel: f64,
    /// The same at least: what a predictor shows to be none of the noise.
    #[serde(default)]
    pub systematic_at_least: f64,
    /// The same at most.
    #[serde(default)]
    pub systematic_at_most: f64,
    /// Noise RMS relative to the response's, in band; of the same response.
    pub noise_rms_rel: f64,
    /// Mean square of what the sim leaves of the select runs, in noise floors; largest response.
    pub chi2_select: f64,
    /// The same on the test runs.
    pub chi2_test: f64,
}

/// Share of one response in the gap.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelShare {
    /// Response.
    pub channel: String,
    /// Share of the systematic power, each response in units of its own level; 0..1.
    pub share_of_gap: f64,
    /// RMS of what the sim leaves, in the response's unit, in band.
    pub rms_error: f64,
}

/// Gap of one response in one band.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BandShare {
    /// Response.
    pub channel: String,
    /// Lower edge.
    pub from_hz: f64,
    /// Upper edge.
    pub to_hz: f64,
    /// Share of the response's systematic power.
    pub share_of_gap: f64,
    /// Systematic power relative to the response's in this band, dB.
    pub systematic_db: f64,
    /// Noise power relative to the response's in this band, dB.
    pub noise_db: f64,
}

/// Gap of one response in one range of amplitude or velocity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RangeShare {
    /// Response.
    pub channel: String,
    /// Lower end, as a share of the largest magnitude.
    pub from: f64,
    /// Upper end.
    pub to: f64,
    /// Share of the response's systematic power.
    pub share_of_gap: f64,
}

/// Error over one stretch of time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SegmentChi2 {
    /// Run.
    pub run: String,
    /// Response.
    pub channel: String,
    /// Start in the run.
    pub from_s: f64,
    /// End in the run.
    pub to_s: f64,
    /// Mean square in noise floors.
    pub chi2: f64,
}

/// How the rig changed between repeats.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TimeVariance {
    /// Share of the repeats' difference that the drive predicts; largest response.
    pub repeat_drive_coherence: f64,
}

/// Where the gap lies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Where {
    /// By response.
    pub channels: Vec<ChannelShare>,
    /// By band.
    pub bands: Vec<BandShare>,
    /// By magnitude of the response.
    pub amplitude: Vec<RangeShare>,
    /// By magnitude of its velocity.
    pub velocity: Vec<RangeShare>,
    /// By second of the select runs.
    pub segments: Vec<SegmentChi2>,
    /// Whether runs excite outside the core's band, where nothing is scored.
    pub out_of_band_excitation: bool,
    /// Changes between repeats.
    pub time_variance: TimeVariance,
}

/// What explains, and does not decide.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Fingerprints {
    /// Share of odd functions of the response in what functions of it explain of the gap.
    pub odd_share: Option<f64>,
    /// Exponent of the gap's RMS against the drive's level: about 0 friction, 1 linear, 2, 3.
    pub gap_level_exponent: Option<f64>,
    /// Closure by a refit of the linear part alone.
    pub linear_refit_closure: Option<f64>,
    /// Frequency of a line that no drive explains.
    pub line_hz: Option<f64>,
}

/// One fitted number of an effect.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    /// Name.
    pub name: String,
    /// Value.
    pub value: f64,
    /// Standard error; none where the runs do not tell it.
    pub se: Option<f64>,
    /// Unit.
    pub unit: String,
}

/// How far the gap closes on runs that were neither fitted nor chosen on.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct HeldOut {
    /// Runs.
    pub runs: Vec<String>,
    /// RMS of what the sim leaves, in band, response unit; of one that was fitted to these runs what a linear part
    /// leaves of runs that it was not fitted to, where that is more.
    pub rms_before: f64,
    /// RMS of what sim and effect leave.
    pub rms_after: f64,
    /// RMS of the noise.
    pub noise_rms: f64,
    /// Mean square in noise floors that the sim leaves.
    pub chi2_before: f64,
    /// That sim and effect leave.
    pub chi2_after: f64,
    /// `1 - (chi2_after - 1)+ / (chi2_before - 1)`.
    pub closure: f64,
    /// Interval that holds the closure in 90 % of cases.
    pub closure_ci90: [f64; 2],
    /// `1 - (after^2 - noise^2)+ / (before^2 - noise^2)`, RMS in band.
    pub closure_rms: f64,
    /// Damage that the sim predicts over that measured, slope 5; none where nothing was damaged.
    pub damage_ratio_before: Option<f64>,
    /// The same with the effect.
    pub damage_ratio_after: Option<f64>,
}

impl HeldOut {
    /// What is left of the gap, by power.
    pub(super) fn left(&self) -> f64 {
        (self.rms_after / self.rms_before.max(f64::MIN_POSITIVE)).powi(2)
    }

    /// The same counted above the RMS of a noise that repeats tell. Without any, 0, all that is left may be noise: it is the
    /// floor, and the closure may be whole.
    pub(super) fn above_noise(self, noise_rms: f64) -> Self {
        let noise_rms = noise_rms.min(self.rms_after);
        let known = noise_rms > 0.0;
        let floor = if known { noise_rms } else { self.rms_after }.max(f64::MIN_POSITIVE);
        let floors = |rms: f64| (rms / floor).powi(2).min(1e12);
        let above = |rms: f64| (rms * rms - noise_rms * noise_rms).max(0.0);
        let gap = above(self.rms_before);
        let closure = if gap > 0.0 { 1.0 - above(self.rms_after) / gap } else { 0.0 };
        let [low, high] = self.closure_ci90;
        Self {
            noise_rms,
            chi2_before: floors(self.rms_before),
            chi2_after: floors(self.rms_after),
            closure,
            closure_rms: closure,
            closure_ci90: [low.min(closure), if known { high.max(closure) } else { 1.0 }],
            ..self
        }
    }
}

/// How far the gap of one response closes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelHeldOut {
    /// Response.
    pub channel: String,
    /// On unseen runs.
    #[serde(flatten)]
    pub held_out: HeldOut,
}

/// How strong an effect is: the drive that would do as much.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Strength {
    /// RMS over the loudest run.
    pub rms: f64,
    /// Largest magnitude there.
    pub peak: f64,
    /// The drive's unit.
    pub unit: String,
    /// The drive.
    #[serde(rename = "as")]
    pub as_drive: String,
}

/// A law as a curve.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Shape {
    /// What it is a function of.
    pub argument: String,
    /// Its unit.
    pub unit: String,
    /// Values of the argument.
    pub x: Vec<f64>,
    /// The law there, in the drive's unit.
    pub force: Vec<f64>,
    /// The least that any group alone asks for.
    pub low: Vec<f64>,
    /// And the most.
    pub high: Vec<f64>,
}

/// What an effect leaves of runs that it was not fitted to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TransferRow {
    /// What the runs have in common.
    pub group: String,
    /// The runs.
    pub runs: Vec<String>,
    /// RMS of what the linear part fitted to the others leaves, unit of the response.
    pub rms_before: f64,
    /// RMS of what linear part and effect leave.
    pub rms_after: f64,
    /// Always: the group is not fitted to.
    pub fitted_on_others: bool,
    /// How much of the effect this group alone asks for, 1 being as much as all together.
    pub parameters_alone: Vec<f64>,
}

/// One of the effects that a hypothesis holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EffectShare {
    /// Effect.
    pub effect: Effect,
    /// Family.
    pub family: Family,
    /// Axis of the effect.
    pub axis: Option<String>,
    /// Channel at which it acts.
    pub at: Option<String>,
    /// Or the two channels between which it acts.
    pub between: Option<[String; 2]>,
    /// Share of the gap that it closes beside those listed before it, on the select runs; 0..1.
    pub share_of_gap: f64,
}

/// What is simulated, one effect or two together, with what that explains.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hypothesis {
    /// Effect; of two the first.
    pub effect: Effect,
    /// Family.
    pub family: Family,
    /// Axis of the effect.
    pub axis: Option<String>,
    /// Channel at which it acts.
    #[serde(default)]
    pub at: Option<String>,
    /// Or the two channels between which it acts.
    #[serde(default)]
    pub between: Option<[String; 2]>,
    /// Response on which it closes most.
    pub channel: String,
    /// That it is the one, 0..1.
    pub probability: f64,
    /// Share of the gap that it leaves on the select runs.
    pub remaining_share: f64,
    /// All effects that it holds, the first one first.
    #[serde(default)]
    pub effects: Vec<EffectShare>,
    /// Its numbers; of several effects each with its effect before it, as in `backlash.half_width`, and of one effect at two
    /// places with the place, as in `backlash@drive_x.half_width`.
    pub parameters: Vec<Parameter>,
    /// How strong it is in terms of a drive; none where that is not known.
    #[serde(default)]
    pub strength: Option<Strength>,
    /// The law over its argument, where it is a curve.
    #[serde(default)]
    pub shape: Option<Shape>,
    /// What it leaves of each group of runs when it is fitted to the others; empty where repeats decided.
    #[serde(default)]
    pub transfer: Vec<TransferRow>,
    /// On unseen runs, at that response.
    pub held_out: HeldOut,
    /// On unseen runs at every response at which it acts, the one whose motion it acts on first.
    pub responses: Vec<ChannelHeldOut>,
    /// Whether its free run stays bounded over the allowed drives.
    pub stable_over_envelope: bool,
}

/// A further effect on top of the first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SecondEffect {
    /// Effect.
    pub effect: Effect,
    /// Its family.
    pub family: Family,
    /// Axis of the effect.
    pub axis: Option<String>,
    /// Response at which it was found: where the first effect leaves most.
    pub channel: String,
    /// Mean square in noise floors that both leave of the select runs, at that response.
    pub chi2: f64,
    /// Closure of both on the test runs.
    pub closure: f64,
}

/// What is left after the best hypothesis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Remaining {
    /// Mean square in noise floors on the select runs.
    pub chi2: f64,
    /// By band.
    pub bands: Vec<BandShare>,
    /// A second effect, if one closes a good part of the rest. Where the verdict blames an effect, the best hypothesis
    /// holds both.
    pub second_effect: Option<SecondEffect>,
}

/// A drive that would tell more.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NextDrive {
    /// `noise`, `slow_sine`, `resonance_sine`, `sweep`, `offset_noise`.
    pub kind: String,
    /// Of a sine.
    pub frequency_hz: Option<f64>,
    /// Relative to the runs' peak.
    pub level_rel: f64,
}

/// The run that is expected to separate the leading effect best from the one that comes nearest to it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NextExperiment {
    /// What to drive.
    pub drive: NextDrive,
    /// The effects it separates.
    pub separates: Vec<Effect>,
    /// Squares in noise floors that the wrong one of them is expected to leave on all runs, fitted to them, over the
    /// rows of this one.
    pub expected_separation: f64,
    /// Whether no allowed run is expected to separate them.
    pub inseparable_in_envelope: bool,
}

/// Part of a run with a role.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunPart {
    /// Run.
    pub run: String,
    /// Start.
    pub from_s: f64,
    /// End.
    pub to_s: f64,
}

/// Which parts of which runs were used for what.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DataSplit {
    /// Fitted to.
    pub fit: Vec<RunPart>,
    /// Chosen on.
    pub select: Vec<RunPart>,
    /// Neither.
    pub test: Vec<RunPart>,
}

/// The engine's part of the report; whoever asked adds the model and the time it took.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// `gap-diagnosis/1`
    pub schema: String,
    /// Whether the sim had seen the effect.
    pub mode: Mode,
    /// Where the noise floor comes from.
    pub noise_floor_source: NoiseSource,
    /// The answer.
    pub verdict: Verdict,
    /// How large the gap is.
    pub gap: Gap,
    /// Where it lies.
    #[serde(rename = "where")]
    pub location: Where,
    /// What explains.
    pub fingerprints: Fingerprints,
    /// Best first.
    pub hypotheses: Vec<Hypothesis>,
    /// What is left.
    pub remaining: Remaining,
    /// What to run next.
    pub next_experiment: Option<NextExperiment>,
    /// What was used for what.
    pub data_split: DataSplit,
    /// What weakens the answer.
    pub warnings: Vec<String>,
}
