//! The schema's history on either database: each file of `migrations/`, compiled in.

use sqlx::SqlSafeStr;
use sqlx::migrate::{Migration, MigrationType, Migrator};

/// Number, name and text of each migration.
const MIGRATIONS: &[(i64, &str, &str)] = &[
    (1, "registry", include_str!("../../migrations/0001_registry.sql")),
    (2, "diagnoses", include_str!("../../migrations/0002_diagnoses.sql")),
    (3, "tokens", include_str!("../../migrations/0003_tokens.sql")),
    (4, "checkpoints", include_str!("../../migrations/0004_checkpoints.sql")),
    (5, "idempotency", include_str!("../../migrations/0005_idempotency.sql")),
    (7, "model_frf", include_str!("../../migrations/0007_model_frf.sql")),
    (8, "adopted", include_str!("../../migrations/0008_adopted.sql")),
    (9, "changes", include_str!("../../migrations/0009_changes.sql")),
    (10, "job_turns", include_str!("../../migrations/0010_job_turns.sql")),
    (11, "iterations", include_str!("../../migrations/0011_iterations.sql")),
    (12, "evaluations", include_str!("../../migrations/0012_evaluations.sql")),
    (14, "studies", include_str!("../../migrations/0014_studies.sql")),
    (16, "fit_records", include_str!("../../migrations/0016_fit_records.sql")),
    (17, "drift", include_str!("../../migrations/0017_drift.sql")),
    (18, "job_losses", include_str!("../../migrations/0018_job_losses.sql")),
];

/// The same of `migrations/postgres/`, whose first one makes what all of before make in SQLite.
const POSTGRES: &[(i64, &str, &str)] =
    &[(18, "registry", include_str!("../../migrations/postgres/0018_registry.sql"))];

/// Migrations of SQLite up to this number.
pub(super) fn up_to(last: i64) -> Migrator {
    migrator(MIGRATIONS.iter().filter(|(version, ..)| *version <= last))
}

/// All migrations of PostgreSQL.
pub(super) fn postgres() -> Migrator {
    migrator(POSTGRES.iter())
}

fn migrator(wanted: impl Iterator<Item = &'static (i64, &'static str, &'static str)>) -> Migrator {
    let migrations = wanted.map(|&(version, name, sql)| {
        Migration::new(version, name.into(), MigrationType::Simple, sql.into_sql_str(), false)
    });
    Migrator::with_migrations(migrations.collect())
}

/// The last migration that this program knows.
pub(super) fn latest() -> i64 {
    MIGRATIONS.iter().map(|(version, ..)| *version).max().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_is_what_the_folder_holds() {
        for (folder, list) in [("migrations", MIGRATIONS), ("migrations/postgres", POSTGRES)] {
            let folder = format!("{}/{folder}", env!("CARGO_MANIFEST_DIR"));
            let mut files: Vec<String> = std::fs::read_dir(&folder)
                .unwrap()
                .map(|entry| entry.unwrap().file_name().into_string().unwrap())
                .filter(|name| name.ends_with(".sql"))
                .collect();
            files.sort();
            let listed: Vec<String> =
                list.iter().map(|(version, name, _)| format!("{version:04}_{name}.sql")).collect();
            assert_eq!(listed, files);
            for (number, file) in list.iter().zip(&files) {
                assert_eq!(number.2, std::fs::read_to_string(format!("{folder}/{file}")).unwrap(), "{file}");
            }
            assert_eq!(list.last().unwrap().0, latest(), "both databases have the same schema");
        }
    }
}
