//! Snapshots of jobs as they change.
