//! A diagnosis as a page: what the store knows of it, in the words of its heading.

use super::Shared;
use super::problem::Answer;
use crate::domain::{Rig, StoredDiagnosis};
use crate::ui::diagnosis::{Heading, Simulation};

/// Media type of the page.
pub const MEDIA_TYPE: &str = "text/html";

/// What stands over the page of a diagnosis.
///
/// # Errors
/// The store's failures.
pub async fn heading(http: &Shared, rig: &Rig, diagnosis: &StoredDiagnosis) -> Answer<Heading> {
    let summary = &diagnosis.summary;
    let (model, adopt) = match &summary.model {
        Some(model) => {
            // The version may be gone since; the report of what it lacked stays.
            let kind = http.store.model(&rig.id, model.version).await?;
            let kind = kind.map_or_else(|| "deleted since".into(), |m| m.kind.as_str().to_owned());
            let call = format!("POST /v1/rigs/{}/diagnoses/{}/adopt", rig.id, summary.id);
            (Simulation::Version { version: model.version.into(), kind }, Some(call))
        }
        None => (Simulation::Outside, None),
    };
    Ok(Heading {
        rig: rig.id.to_string(),
        rig_name: rig.name.clone(),
        diagnosis: summary.id.to_string(),
        when: summary.created_at.strftime("%Y-%m-%d %H:%M UTC").to_string(),
        model,
        elapsed_s: diagnosis.elapsed_s,
        adopt,
    })
}
