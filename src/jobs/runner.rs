//! The workers: tasks that claim jobs and see them through.
