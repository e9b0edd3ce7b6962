//! Fatigue: turning points, four-point rainflow, Palmgren-Miner damage, Multi-Rain, and the counts
//! that labs read as tables.
//!
//! Everything is `f64`. *Range* is maximum minus minimum, *amplitude* half of it; *residue* is the
//! turning points that close no cycle. No figure is quantised unless classes are asked for, and
//! every answer carries the settings that made it.

mod band;
mod block;
mod classes;
mod counts;
mod damage;
mod multi_rain;
mod rainflow;
mod report;
mod turning;

pub use band::damage_band;
pub use classes::{ClassSettings, Classes, MAX_CLASSES};
pub use counts::{Counts, FromTo, LevelCrossing, RangePair, counts};
pub use damage::{DamageRatio, DamageSettings, NoRatio, damage};
pub use multi_rain::{MultiRain, damage_by_direction, direction, multi_rain};
pub use rainflow::{Cycle, Rainflow, Residue};
pub use report::{
    ChannelCounts, ChannelDamage, CountsReport, DamageChannel, DamageGroup, DamageReport, GroupDamage,
    GroupTarget, Omission, OmittedGroup, TargetDamage, counts_report, damage_report,
};
pub use turning::{Prefilter, TurningPoint, turning_points};
