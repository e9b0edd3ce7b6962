//! The columns of a measurement file as channels of a rig.

use serde::Serialize;

use super::problem::FieldError;
use super::rig::{Channel, Rig};
use super::units;

/// Stands for every column that is no channel of the rig, among the columns to leave out.
pub const ALL_OTHERS: &str = "*";

/// A column of a file, and what it is taken for.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Column {
    /// Name in the file, or the one that the request gave it.
    pub name: String,
    /// Unit in the file, if it has one.
    pub unit: Option<String>,
    /// The rig's channel; `None` for a column that is left out.
    pub channel: Option<String>,
    /// Values of the file times this number are in the channel's unit.
    pub factor: f64,
}

impl Column {
    /// The conversion of its values, a sentence, if there is one.
    pub fn conversion(&self, rig: &Rig) -> Option<String> {
        let channel = self.channel.as_ref().filter(|_| self.factor != 1.0)?;
        let (unit, own) = (self.unit.as_deref()?, &rig.channel(channel)?.unit);
        Some(format!("{channel}: converted from {unit} to {own}, times {}.", self.factor))
    }
}

/// The columns that are left out, in a sentence whose length is bounded, if there are any.
pub fn left_out(columns: &[Column]) -> Option<String> {
    const NAMED: usize = 8;
    const CHARS: usize = 40;
    let names: Vec<&str> =
        columns.iter().filter(|column| column.channel.is_none()).map(|column| column.name.as_str()).collect();
    let short = |name: &&str| format!("{:?}", name.chars().take(CHARS).collect::<String>());
    let named: Vec<String> = names.iter().take(NAMED).map(short).collect();
    let named = named.join(", ");
    match names.len() {
        0 => None,
        1 => Some(format!("Column {named} was left out.")),
        n if n <= NAMED => Some(format!("Columns {named} were left out.")),
        n => Some(format!("Columns {named} and {} more were left out.", n - NAMED)),
    }
}

/// Reasons why columns do not become channels, one each.
#[derive(Debug, PartialEq)]
pub enum ColumnFault {
    /// Columns that are no channels of the rig.
    Unknown(Vec<FieldError>),
    /// Channels that come twice, units of another quantity.
    Unsuitable(Vec<FieldError>),
}

/// Finds the channel of each column by its name: as it stands, as the channel's or as one of its aliases; without a
/// unit in brackets behind it; by either of these whatever the case of its letters, where one channel only is meant. `ignore` names columns to leave out, or
/// [`ALL_OTHERS`]. `units` are those of the file, where it has some; an empty one is none.
///
/// # Errors
/// All columns at fault.
pub fn assign(
    names: &[String],
    units: Option<&[String]>,
    rig: &Rig,
    ignore: &[String],
) -> Result<Vec<Column>, ColumnFault> {
    let listed = |name: &str| ignore.iter().any(|ignored| ignored == name);
    let (mut columns, mut unknown, mut unsuitable) = (Vec::new(), Vec::new(), Vec::new());
    for (i, name) in names.iter().enumerate() {
        let (stem, bracketed) = split_unit(name);
        let in_row =
            units.and_then(|units| units.get(i)).map(|unit| unit.trim()).filter(|unit| !unit.is_empty());
        let found = if listed(name) || listed(stem) { None } else { find(rig, name, stem) };
        if found.is_none() && !listed(name) && !listed(stem) && !listed(ALL_OTHERS) {
            let limit = "a channel of the rig, or a column that `ignore` names";
            unknown.push(FieldError::new("", limit).on_channel(name));
            continue;
        }
        let unit = in_row.or(bracketed.filter(|_| !found.is_some_and(|(_, whole)| whole)));
        let channel = found.map(|(channel, _)| channel);
        let factor = match (unit, channel) {
            (Some(unit), Some(channel)) => units::factor(unit, &channel.unit),
            _ => Some(1.0),
        };
        if let (None, Some(channel)) = (factor, channel) {
            let found = unit.unwrap_or_default();
            let limit =
                format!("{:?}, the rig's unit, or one of the same quantity; found {found:?}", channel.unit);
            unsuitable.push(FieldError::new(format!("/units/{i}"), limit).on_channel(name));
        }
        let channel = channel.map(|channel| channel.name.clone());
        if channel.is_some() && columns.iter().any(|c: &Column| c.channel == channel) {
            unsuitable.push(FieldError::new(format!("/channels/{i}"), "each channel once").on_channel(name));
        }
        columns.push(Column {
            name: name.clone(),
            unit: unit.map(str::to_owned),
            channel,
            factor: factor.unwrap_or(1.0),
        });
    }
    if !unknown.is_empty() {
        return Err(ColumnFault::Unknown(unknown));
    }
    if unsuitable.is_empty() { Ok(columns) } else { Err(ColumnFault::Unsuitable(unsuitable)) }
}

/// The channel that a name means, and whether the name with its brackets is the channel's.
fn find<'r>(rig: &'r Rig, name: &str, stem: &str) -> Option<(&'r Channel, bool)> {
    let called = |wanted: &str| {
        let aliased =
            || rig.channels.iter().find(|channel| channel.aliases.iter().any(|alias| alias == wanted));
        rig.channel(wanted).or_else(aliased)
    };
    let alike = |wanted: &str| {
        let wanted = wanted.to_lowercase();
        let is_meant = |channel: &&Channel| {
            std::iter::once(&channel.name).chain(&channel.aliases).any(|name| name.to_lowercase() == wanted)
        };
        let mut found = rig.channels.iter().filter(is_meant);
        found.next().filter(|_| found.next().is_none())
    };
    called(name)
        .map(|channel| (channel, true))
        .or_else(|| Some((called(stem)?, false)))
        .or_else(|| Some((alike(name)?, true)))
        .or_else(|| Some((alike(stem)?, false)))
}

/// A name without the unit in brackets at its end, and the unit.
fn split_unit(name: &str) -> (&str, Option<&str>) {
    let split = |open, close| {
        let (stem, unit) = name.strip_suffix(close)?.rsplit_once(open)?;
        (!stem.trim().is_empty()).then_some((stem.trim(), Some(unit.trim()).filter(|unit| !unit.is_empty())))
    };
    split('[', ']').or_else(|| split('(', ')')).unwrap_or((name, None))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::rig::tests::{draft, rig as rig_of};
    use super::*;

    fn rig() -> Rig {
        rig_of(draft(json!({
            "id": "bench", "sample_rate_hz": 100.0,
            "channels": [
                {"name": "drive_x", "unit": "kN", "role": "drive"},
                {"name": "y (2)", "unit": "mm", "role": "response"},
                {"name": "Y", "unit": "counts", "role": "response"},
                {"name": "y", "unit": "mm", "role": "response"}
            ]
        })))
    }

    fn own(texts: &[&str]) -> Vec<String> {
        texts.iter().map(|text| (*text).to_owned()).collect()
    }

    /// Channel and factor of one column.
    fn one(name: &str, unit: &str) -> Result<(Option<String>, f64), ColumnFault> {
        let found = assign(&own(&[name]), Some(&own(&[unit])), &rig(), &[])?.remove(0);
        Ok((found.channel, found.factor))
    }

    #[test]
    fn a_column_is_found_by_its_name_with_and_without_its_unit() {
        for (name, unit, channel, factor) in [
            ("drive_x", "", "drive_x", 1.0),
            ("drive_x", "N", "drive_x", 1e-3),
            ("drive_x [N]", "", "drive_x", 1e-3),
            ("Drive_X (kN)", "", "drive_x", 1.0),
            ("DRIVE_X", "MN", "drive_x", 1e3),
            ("y (2)", "", "y (2)", 1.0),
            ("y (2) [m]", "", "y (2)", 1e3),
            ("Y", "counts", "Y", 1.0),
            ("y", "µm", "y", 1e-3),
        ] {
            assert_eq!(one(name, unit), Ok((Some(channel.into()), factor)), "{name} {unit}");
        }
    }

    #[test]
    fn other_quantities_repeats_and_unknown_columns_are_named() {
        let unsuitable =
            |names: &[&str], units: &[&str]| match assign(&own(names), Some(&own(units)), &rig(), &[]) {
                Err(ColumnFault::Unsuitable(found)) => {
                    found.into_iter().map(|e| (e.pointer, e.channel.unwrap())).collect::<Vec<_>>()
                }
                other => panic!("{other:?}"),
            };
        assert_eq!(unsuitable(&["drive_x"], &["mm"]), [("/units/0".into(), "drive_x".into())]);
        assert_eq!(unsuitable(&["Y"], &["V"]), [("/units/0".into(), "Y".into())]);
        assert_eq!(unsuitable(&["y", "y [mm]"], &["", ""]), [("/channels/1".into(), "y [mm]".into())]);
        let found = assign(&own(&["temp", "y", "oil"]), None, &rig(), &[]).unwrap_err();
        let ColumnFault::Unknown(found) = found else { panic!("{found:?}") };
        let named: Vec<_> = found.iter().map(|e| e.channel.as_deref().unwrap()).collect();
        assert_eq!(named, ["temp", "oil"]);
    }

    #[test]
    fn columns_are_left_out_by_name_or_all_that_are_unknown() {
        let names = own(&["temp [°C]", "y", "oil"]);
        for ignore in [&["temp", "oil"][..], &["temp [°C]", "oil"], &["*"]] {
            let found = assign(&names, None, &rig(), &own(ignore)).unwrap();
            let channels: Vec<_> = found.iter().map(|c| c.channel.as_deref()).collect();
            assert_eq!(channels, [None, Some("y"), None], "{ignore:?}");
            assert_eq!(found[0].unit.as_deref(), Some("°C"));
            let told = left_out(&found).unwrap();
            assert_eq!(told, r#"Columns "temp [°C]", "oil" were left out."#);
        }
        assert_eq!(left_out(&[]), None);
        let many: Vec<String> = (0..1000).map(|i| format!("{i}{}", "x".repeat(4000))).collect();
        let told = left_out(&assign(&many, None, &rig(), &own(&["*"])).unwrap()).unwrap();
        assert!(told.len() < 500 && told.ends_with("and 992 more were left out."), "{told}");
        assert!(
            matches!(assign(&names, None, &rig(), &own(&["temp"])), Err(ColumnFault::Unknown(f)) if f.len() == 1)
        );
    }
}
