//! The recording at the rate of the analysis, cut into weighted segments, and the linear parts that laws are
//! tried beside.

use rayon::prelude::*;

use super::band::{Band, LowPass, Thinner};
use super::correlate::Correlator;
use super::groups::Stretch;
use super::input::Recording;
use super::judge::Base;
use super::kernel::HeldSums;
use super::linear_part::{LEAD, Setting, WithModes, choose, longest, modes_beside, moved, with_modes};
use super::modes;
use super::moments::{Lags, Moments};
use super::motion::{Limits, Motion};
use super::pieces::Pieces;
use super::place::{Argument, Seen, limits};
use super::regressors::Regressors;
use super::track::{Segment, Track, delayed, deviation, less};

/// Logarithm of held-out errors by which a finite impulse response has to beat modes to be tried too.
const BETTER: f64 = 0.02;
/// A group's level counts at most so many times more or less than the mean.
const MOST_WEIGHT: f64 = 30.0;

/// The recording at the rate of the analysis.
pub(super) struct Desk<'a> {
    pub recording: &'a Recording,
    pieces: &'a Pieces<'a>,
    pub band: Band,
    /// Limits of what is integrated and differentiated.
    pub limits: Limits,
    pub thinner: Thinner,
    /// What free runs leave is judged behind this filter: that of a desk of fewer samples whose errors count beside.
    pub judged: Option<LowPass>,
    /// Samples of each record that are looked at, at the recording's own rate.
    pub used: Vec<usize>,
    pub segments: Vec<Segment>,
    pub drives: Vec<Track>,
    /// Running sums of the drives, `[record][drive]`.
    pub sums: Vec<Vec<HeldSums>>,
    /// Without what known effects add to them.
    pub responses: Vec<Track>,
    /// What these add to each; empty without any.
    pub added: Vec<Track>,
    /// The programme's time of each record's first and last sample, from 0 to 1.
    pub clocks: Vec<[f64; 2]>,
}

impl<'a> Desk<'a> {
    pub fn new(pieces: &'a Pieces<'a>) -> Self {
        Self::in_band(pieces, pieces.band)
    }

    /// The same at the recording's own rate; `None` where it is.
    pub fn unthinned(&self) -> Option<Self> {
        let band = Band { step: 1, ..self.band };
        (self.band.step > 1).then(|| Self::in_band(self.pieces, band))
    }

    /// The same where what is left counts beside errors of a desk of fewer samples, whose `step` is given.
    pub fn judged_as(pieces: &'a Pieces<'a>, step: usize) -> Self {
        let desk = Self::new(pieces);
        let times = step as f64 / desk.band.step as f64;
        Self { judged: (times > 1.0).then(|| LowPass::new(times)), ..desk }
    }

    fn in_band(pieces: &'a Pieces<'a>, band: Band) -> Self {
        let (recording, step) = (&*pieces.recording, band.step);
        let limits = limits(recording, band);
        let thinner = Thinner::new(step);
        let share = pieces.share(step);
        let mut used = vec![0; recording.records.len()];
        let mut segments: Vec<Segment> = Vec::new();
        for stretch in pieces.stretches.iter() {
            let n = recording.records[stretch.record].drive.n_samples();
            let (start, end) = (stretch.samples.start.min(n), stretch.samples.end.min(n));
            let from = start.div_ceil(step);
            let kept = ((end / step).saturating_sub(from) as f64 * share) as usize;
            used[stretch.record] = used[stretch.record].max(((from + kept) * step).min(n));
            let Stretch { record, group, part, unit, .. } = *stretch;
            segments.push(Segment { record, rows: from..from + kept, group, part, unit, weight: 1.0 });
        }
        let thin = |x: &[f64], record: usize| thinner.thin(&x[..used[record]]);
        let records = &recording.records;
        let of = |r: usize, drive: bool, c: usize| {
            let signal = if drive { &records[r].drive } else { &records[r].response };
            thin(signal.channel(c), r)
        };
        let tracks = |drive: bool, count: usize| -> Vec<Track> {
            (0..count)
                .into_par_iter()
                .map(|c| (0..records.len()).map(|r| of(r, drive, c)).collect())
                .collect()
        };
        let drives = tracks(true, recording.drives.len());
        let mut responses = tracks(false, recording.responses.len());
        let known = recording.records.iter().any(|record| record.added.is_some());
        let count = if known { recording.responses.len() } else { 0 };
        let of_record = |c: usize, r: usize| match &records[r].added {
            Some(added) => thin(added.channel(c), r),
            None => vec![0.0; drives[0][r].len()],
        };
        let added: Vec<Track> =
            (0..count).map(|c| (0..records.len()).map(|r| of_record(c, r)).collect()).collect();
        for (response, added) in responses.iter_mut().zip(&added) {
            *response = less(response, added);
        }
        responses.iter_mut().for_each(still);
        let sums =
            (0..records.len()).map(|r| drives.iter().map(|d| HeldSums::new(&d[r])).collect()).collect();
        let mut desk = Self {
            recording,
            pieces,
            band,
            limits,
            thinner,
            judged: None,
            used,
            segments,
            drives,
            sums,
            responses,
            added,
            clocks: clocks(recording, pieces.programme),
        };
        desk.leave_out_the_start();
        desk.weigh();
        desk
    }

    pub fn rate_hz(&self) -> f64 {
        self.recording.sample_rate_hz() / self.band.step as f64
    }

    /// Groups that are held out in turn.
    pub fn groups(&self) -> usize {
        self.segments.iter().map(|s| s.group + 1).max().unwrap_or(0)
    }

    /// Rows that are fitted and judged.
    pub fn rows(&self) -> usize {
        self.segments.iter().map(|s| s.rows.len()).sum()
    }

    /// Longest memory of a linear part that the records can carry, samples.
    pub fn longest(&self) -> usize {
        longest(&self.segments, &self.lengths(), self.drives.len())
    }

    pub fn lengths(&self) -> Vec<usize> {
        self.drives[0].iter().map(Vec::len).collect()
    }

    /// No run needs to start at rest: what a record's first rows remember is not known.
    fn leave_out_the_start(&mut self) {
        let lengths = self.lengths();
        let memory = self.longest();
        for segment in &mut self.segments {
            let skip = memory.min(lengths[segment.record] / 6);
            segment.rows.start = segment.rows.start.max(skip);
        }
        self.segments.retain(|s| s.rows.len() >= 16);
        let mut groups: Vec<usize> = self.segments.iter().map(|s| s.group).collect();
        groups.sort_unstable();
        groups.dedup();
        for segment in &mut self.segments {
            segment.group = groups.iter().position(|g| *g == segment.group).unwrap_or(0);
        }
    }

    /// Weighs each group by its drives' level.
    fn weigh(&mut self) {
        let levels = |segments: &[Segment]| -> Vec<f64> {
            self.drives.iter().map(|d| deviation(d, segments)).collect()
        };
        let all = levels(&self.segments);
        let n_groups = self.segments.iter().map(|s| s.group + 1).max().unwrap_or(0);
        let weights: Vec<f64> = (0..n_groups)
            .map(|g| {
                let own: Vec<Segment> = self.segments.iter().filter(|s| s.group == g).cloned().collect();
                let (mut sum, mut count) = (0.0, 0.0);
                for (level, all) in levels(&own).iter().zip(&all).filter(|(_, all)| **all > 0.0) {
                    sum += (level / all).powi(2);
                    count += 1.0;
                }
                let level = if count > 0.0 { f64::sqrt(sum / count) } else { 1.0 };
                1.0 / level.clamp(1.0 / MOST_WEIGHT, MOST_WEIGHT)
            })
            .collect();
        for segment in &mut self.segments {
            segment.weight = weights[segment.group];
        }
    }

    /// Linear parts: modes, and a finite impulse response where it predicts better or no modes can be had. A law
    /// that is strong disturbs both, each in its way.
    pub fn bases(&self) -> Vec<Base<'_>> {
        let memory = self.longest();
        let all = Lags { lead: LEAD, span: memory + LEAD };
        let moments = Moments::of(&self.drives, &self.responses, &self.segments, all);
        let (error, setting) = choose(&moments, &self.segments, all);
        let mut bases = Vec::new();
        let modes = with_modes(&self.drives, &self.responses, &self.segments, setting.lags.lead);
        let by_modes = modes.as_ref().map_or(f64::INFINITY, |m| m.error);
        bases.extend(modes.and_then(|modes| self.by_modes(modes)));
        if bases.is_empty() || error < by_modes - BETTER {
            let chosen: Vec<Moments> = moments.iter().map(|m| m.select(all, setting.lags)).collect();
            let lags = Regressors::Lags(Correlator::new(&self.drives, &self.segments, setting.lags));
            let centred = centred(&self.responses, &self.segments);
            bases.extend(Base::new(&chosen, &self.segments, centred, lags, setting));
        }
        bases
    }

    /// A linear part with a lead whose modes are found beside bends of motions: a law that is strong has moved those of the
    /// others. `None` where it cannot be had.
    pub fn base_beside_bends(&self, lead: usize, motions: &[Argument]) -> Option<Base<'_>> {
        let forces: Vec<Track> = motions.iter().flat_map(|argument| self.bends(argument)).collect();
        self.by_modes(self.modes_beside(&forces, lead)?)
    }

    fn by_modes(&self, modes: WithModes) -> Option<Base<'_>> {
        let centred = centred(&self.responses, &self.segments);
        let regressors = Regressors::Columns(modes.columns);
        Base::new(&modes.moments, &self.segments, centred, regressors, modes.setting)
    }

    fn modes_beside(&self, forces: &[Track], lead: usize) -> Option<WithModes> {
        modes_beside(&self.drives, forces, &self.responses, &self.segments, lead)
    }

    /// A linear part of modes that are found beside forces, with the lead of another.
    pub fn setting_beside(&self, forces: &[Track], like: &Setting) -> Option<Setting> {
        Some(self.modes_beside(forces, like.lags.lead)?.setting)
    }

    /// What springs, stops, gaps, friction and dampers would make of a motion, as far as a few shapes tell.
    fn bends(&self, argument: &Argument) -> Vec<Track> {
        let scale = argument.scale;
        let shapes: [fn(f64, f64) -> f64; 6] = [
            |d, _| d * d * d,
            |d, _| d - d.clamp(-0.5, 0.5),
            |d, _| (d - 1.0).max(0.0),
            |d, _| (d + 1.0).min(0.0),
            |_, v| (5.0 * v).tanh(),
            |_, v| v * v.abs(),
        ];
        let of = |shape: fn(f64, f64) -> f64| -> Track {
            let of_record = |m: &Motion| -> Vec<f64> {
                let at = |(d, v): (&f64, &f64)| shape((d - scale.centre) / scale.d, v / scale.v);
                self.thinner.thin(&m.d.iter().zip(&m.v).map(at).collect::<Vec<f64>>())
            };
            argument.motion.iter().map(of_record).collect()
        };
        shapes.into_iter().map(of).collect()
    }

    /// A linear part of modes for other responses, beside the lead of one for these.
    pub fn setting_of(&self, responses: &[Track], like: &Setting) -> Option<Setting> {
        let found = with_modes(&self.drives, responses, &self.segments, like.lags.lead)?;
        Some(Setting { apart: like.apart, ..found.setting })
    }

    /// The modes of a linear part moved to where nearly the same responses have them.
    pub fn moved(&self, responses: &[Track], near: &Setting) -> Option<Setting> {
        moved(near, &self.drives, responses, &self.segments)
    }

    /// A linear part set alike, with further signals among the responses; `None` where it is singular to rounding.
    pub fn rebased(&self, setting: &Setting, further: &[Track]) -> Option<Base<'_>> {
        let responses: Vec<Track> = self.responses.iter().chain(further).cloned().collect();
        let (moments, regressors) = match &setting.poles {
            Some(poles) => {
                let Lags { lead, span } = setting.lags;
                let columns = modes::columns(&self.drives, &self.segments, poles, lead, span);
                let moments = Moments::of_columns(&columns, &responses, &self.segments);
                (moments, Regressors::Columns(columns))
            }
            None => {
                let moments = Moments::of(&self.drives, &responses, &self.segments, setting.lags);
                let lags = Correlator::new(&self.drives, &self.segments, setting.lags);
                (moments, Regressors::Lags(lags))
            }
        };
        let centred = centred(&responses, &self.segments);
        Base::new(&moments, &self.segments, centred, regressors, setting.clone())
    }

    /// What known effects make of the motion of an argument, at the rate of the analysis; `None` without any.
    pub fn added_to(&self, argument: &Argument) -> Option<Track> {
        if self.added.is_empty() {
            return None;
        }
        let (seen, rate) = (Seen::of(argument), self.recording.sample_rate_hz());
        let of = |(record, drive): (usize, &Vec<f64>)| {
            let Some(added) = &self.recording.records[record].added else { return vec![0.0; drive.len()] };
            let used: Vec<&[f64]> = added.channels().iter().map(|x| &x[..self.used[record]]).collect();
            self.thinner.thin(&seen.displacement(&used, rate))
        };
        Some(self.drives[0].iter().enumerate().map(of).collect())
    }

    /// A signal at the rate of the analysis.
    pub fn thinned(&self, signal: &[Vec<f64>]) -> Track {
        signal.iter().map(|x| self.thinner.thin(x)).collect()
    }
}

/// Responses of every segment, centred and weighted, `[segment][response]`.
fn centred(responses: &[Track], segments: &[Segment]) -> Vec<Vec<Vec<f64>>> {
    let of = |s: &Segment| responses.iter().map(|y| delayed(&y[s.record], s, 0)).collect();
    segments.iter().map(of).collect()
}

/// Clears a track that moves by no more than rounding, such as a constant after thinning.
fn still(track: &mut Track) {
    let all = || track.iter().flatten().copied();
    let (low, high) = all().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
    if high - low <= 1e-9 * low.abs().max(high.abs()) {
        track.iter_mut().for_each(|x| x.fill(0.0));
    }
}

/// Places in time of each record's start and end, from the start of the programme, 0, to its end, 1.
fn clocks(recording: &Recording, [first, last]: [f64; 2]) -> Vec<[f64; 2]> {
    let length = (last - first).max(f64::MIN_POSITIVE);
    let at = |t: f64| (t - first) / length;
    recording.records.iter().map(|r| [at(r.started_s), at(r.started_s + r.drive.duration_s())]).collect()
}
