//! A model's FRF with the quality of its estimate, or its regularised inverse.

mod arrays;
mod csv;
mod document;
mod npy;
mod query;

use axum::extract::State;
use axum::http::header::CONTENT_LENGTH;
use axum::http::{HeaderMap, HeaderName};
use axum::response::IntoResponse;

use super::body::json;
use super::body::pieces::{Pieces, Written};
use super::body::signals::header_names;
use super::negotiate::{self, CSV, NPY};
use super::params::Params;
use super::paths::{OfModel, no_model, no_rig};
use super::problem::{Answer, Problem};
use super::{Shared, codes};
use crate::compute::Class;
use crate::domain::Rig;
use crate::engine::frf::Frf;
use crate::engine::model::RigModel;
use arrays::Arrays;
use csv::FrfTable;
use document::FrfDocument;
use npy::FrfNpyPieces;
use query::{Part, Query};

/// `GET /v1/rigs/{rig}/models/{version}/frf`
pub async fn show(
    State(http): State<Shared>,
    OfModel(rig, version): OfModel,
    mut params: Params,
    headers: HeaderMap,
) -> Answer {
    let query = Query::take(&mut params)?;
    params.finish()?;
    let media_type = negotiate::choose(&headers, &[json::MEDIA_TYPE, CSV, NPY])?;
    let rig_row = http.store.rig(&rig).await?.ok_or_else(|| no_rig(rig.as_str()))?;
    let loaded = http.models.version(&rig, version).await?.ok_or_else(|| no_model(&version.to_string()))?;
    let model = loaded.model();
    let frf = frf_of(model)?;
    let lines = query.lines(frf)?;
    let values = lines.len() * frf.n_inputs * frf.n_outputs;
    let work = if query.inverse.is_some() { values * frf.n_inputs.min(frf.n_outputs) } else { values };
    let mut head = HeaderMap::new();
    let mut put = |name: &'static str, value: String| -> Answer<()> {
        head.insert(HeaderName::from_static(name), value.parse().map_err(Problem::internal)?);
        Ok(())
    };
    put("content-type", media_type.to_owned())?;
    put("rigcast-model-version", version.to_string())?;
    put("rigcast-model-digest", loaded.sha256.clone())?;
    if media_type == NPY {
        put("rigcast-inputs", header_names(&model.inputs))?;
        put("rigcast-outputs", header_names(&model.outputs))?;
        put("rigcast-first-hz", (lines.start as f64 * frf.df_hz()).to_string())?;
        put("rigcast-step-hz", frf.df_hz().to_string())?;
    }
    let units = Units::of(&rig_row, model);
    let (written, size) = http
        .in_time(Class::of_values(work), move |deadline| {
            let arrays = Arrays::of(loaded, &query, lines, media_type == NPY, deadline)?;
            let mut size = None;
            let pieces: Pieces = match media_type {
                NPY => {
                    let pieces = FrfNpyPieces::new(arrays, query.part.unwrap_or(Part::H))?;
                    size = Some(pieces.size());
                    Box::new(pieces)
                }
                CSV => Box::new(FrfTable::new(arrays, &units)?),
                _ => Box::new(FrfDocument::new(arrays, &units)?),
            };
            Ok((Written::begin(pieces).map_err(Problem::internal)?, size))
        })
        .await?;
    if let Some(size) = size {
        head.insert(CONTENT_LENGTH, size.into());
    }
    Ok((head, written.into_body(&http.compute)).into_response())
}

/// The FRF of a model, or the refusal of a model that has none.
pub(super) fn frf_of(model: &RigModel) -> Answer<&Frf> {
    model.frf.as_ref().ok_or_else(|| {
        let detail = format!("A model of kind {} has no FRF.", model.version_kind().as_str());
        Problem::new(codes::MODEL_NO_FRF, detail)
    })
}

/// Units of a model's channels as the rig has them; empty where it does not say.
struct Units {
    inputs: Vec<String>,
    outputs: Vec<String>,
}

impl Units {
    fn of(rig: &Rig, model: &RigModel) -> Self {
        let unit = |name: &String| rig.channel(name).map(|c| c.unit.clone()).unwrap_or_default();
        Self {
            inputs: model.inputs.iter().map(unit).collect(),
            outputs: model.outputs.iter().map(unit).collect(),
        }
    }

    /// Unit of a path from one channel to another.
    fn ratio(to: &str, from: &str) -> String {
        let bracketed = |unit: &str| {
            if unit.contains(['/', '*', ' ', '·']) { format!("({unit})") } else { unit.to_owned() }
        };
        match (to, from) {
            (to, "") => to.to_owned(),
            ("", from) => format!("1/{}", bracketed(from)),
            (to, from) => format!("{}/{}", bracketed(to), bracketed(from)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_unit_of_a_path_is_that_of_its_end_over_that_of_its_start() {
        assert_eq!(Units::ratio("mm", "kN"), "mm/kN");
        assert_eq!(Units::ratio("m/s^2", "N m"), "(m/s^2)/(N m)");
        assert_eq!(
            (Units::ratio("", "V"), Units::ratio("V", ""), Units::ratio("", "")),
            ("1/V".into(), "V".into(), String::new())
        );
    }
}
