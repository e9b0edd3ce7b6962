//! Tokens, operations, and the documentation of the API.

use axum::extract::State;

use super::rigs::whole;
use super::{Visitor, html};
use crate::compute::Class;
use crate::http::Shared;
use crate::http::health::accepting;
use crate::http::params::NoParams;
use crate::http::problem::Answer;
use crate::ui::tokens::{self as ui, Operations};

/// `GET /tokens`
pub async fn tokens(State(http): State<Shared>, visitor: Visitor, _: NoParams) -> Answer {
    let found = http.store.tokens(&whole()).await?;
    html(ui::page(&visitor.shown, &found.items, found.next.is_some()))
}

/// `GET /operations`
pub async fn operations(State(http): State<Shared>, visitor: Visitor, _: NoParams) -> Answer {
    let has_room = accepting(&http).await?;
    let compute = [Class::Predict, Class::Long].map(|class| http.compute.queue(class));
    let depth =
        |(class, in_use, waiting): (&str, usize, usize)| (class.to_owned(), in_use as u64, waiting as u64);
    let queues = http.admission.all().into_iter().chain(compute).map(|queue| depth(queue.depth())).collect();
    let jobs = http.store.count_jobs().await?;
    let jobs = jobs.into_iter().map(|(state, n)| (state.as_str().to_owned(), n)).collect();
    let degraded = http.models.degraded().await?;
    let seen = degraded.into_iter().filter(|found| visitor.caller.reaches(&found.rig));
    let degraded = seen.map(|found| (found.rig.to_string(), found.reason)).collect();
    let of = Operations {
        has_room,
        queues,
        jobs,
        loaded_models: http.models.loaded() as u64,
        degraded,
        quarantined: http.store.quarantined().await?.len(),
        version: crate::VERSION.to_owned(),
    };
    html(ui::operations(&visitor.shown, &of))
}

/// `GET /docs`
pub async fn docs(visitor: Answer<Visitor>, _: NoParams) -> Answer {
    html(ui::docs(visitor.ok().as_ref().map(|visitor| &visitor.shown)))
}
