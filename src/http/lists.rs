//! The parameters that all lists share.

use super::params::{Params, invalid};
use super::problem::Answer;
use crate::domain::page::{DEFAULT_LIMIT, MAX_LIMIT};
use crate::domain::{Cursor, PageRequest};

/// Takes `limit` and `cursor`.
///
/// # Errors
/// `query.invalid` for a limit out of range or a cursor that is none of ours.
pub fn page(params: &mut Params) -> Answer<PageRequest> {
    let range = format!("a number from 1 to {MAX_LIMIT}");
    let limit = params.parse::<u32>("limit", &range)?.unwrap_or(DEFAULT_LIMIT);
    if !(1..=MAX_LIMIT).contains(&limit) {
        return Err(invalid("limit", format!("is {limit}"), &range));
    }
    let cursor = params
        .one("cursor")?
        .map(|text| {
            Cursor::parse(&text)
                .map_err(|_| invalid("cursor", "is none", "the `next` of a page of this list"))
        })
        .transpose()?;
    Ok(PageRequest { limit, cursor })
}
