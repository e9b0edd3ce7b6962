//! What the report's page draws beside the report itself.

use serde::{Deserialize, Serialize};

/// Curves and clouds of a diagnosis, thinned to what a page can show.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Views {}
