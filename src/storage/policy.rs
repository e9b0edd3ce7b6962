//! The fit policy: which fits an accepted run sets off.
