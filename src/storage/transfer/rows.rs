//! All rows of a registry, from one database to the other.

use crate::storage::StoreError;
use crate::storage::database::{FromRow, Row, Session, Value, sql};

/// Every table that both databases have, and the columns that its rows are known by.
const TABLES: [(&str, &str); 15] = [
    ("rigs", "id"),
    ("models", "rig, version"),
    ("fit_records", "rig, version"),
    ("runs", "id"),
    ("jobs", "id"),
    ("job_losses", "job, stopped, seed, epoch"),
    ("checkpoints", "job, part"),
    ("worker_time", "owner, rig"),
    ("diagnoses", "id"),
    ("iterations", "id"),
    ("evaluations", "id"),
    ("studies", "job"),
    ("drift", "rig, version, run"),
    ("tokens", "id"),
    ("idempotency_keys", "owner, key"),
];

/// Values of one statement; both databases take more.
const VALUES: usize = 4000;

/// Rows that are in memory at once.
const PAGE: i64 = 2000;

/// A column of a table in SQLite.
struct Column {
    name: String,
    kind: String,
}

/// A row in the order of the columns of SQLite's table, whichever database it is from.
struct Cells(Vec<Value>);

/// Reads rows of which only the database knows the columns: as many as it has, by their types.
impl FromRow for Cells {
    fn from_row(row: &Row) -> sqlx::Result<Self> {
        (0..row.len()).map(|at| row.value(at)).collect::<sqlx::Result<_>>().map(Self)
    }
}

/// A table with what is needed to read and write its rows.
struct Table {
    name: &'static str,
    key: &'static str,
    columns: Vec<Column>,
}

impl Table {
    fn names(&self) -> String {
        let names: Vec<&str> = self.columns.iter().map(|column| column.name.as_str()).collect();
        names.join(", ")
    }

    /// Its rows in the order of their keys, from the `from`th on, a page at most.
    async fn rows(&self, session: &mut Session, from: i64) -> Result<Vec<Vec<Value>>, StoreError> {
        let read = format!(
            "SELECT {} FROM {} ORDER BY {} LIMIT {PAGE} OFFSET {from}",
            self.names(),
            self.name,
            self.key
        );
        let rows: Vec<Cells> = sql(read).fetch_all(session).await?;
        let rows = rows.into_iter().map(|cells| {
            // NULL has the type of its column.
            let typed = cells.0.into_iter().zip(&self.columns);
            typed.map(|(value, column)| value.or_null_of(&column.kind)).collect()
        });
        Ok(rows.collect())
    }

    async fn insert(&self, session: &mut Session, rows: Vec<Vec<Value>>) -> Result<(), StoreError> {
        let width = self.columns.len();
        let mut rows = rows.into_iter().peekable();
        while rows.peek().is_some() {
            let some: Vec<Vec<Value>> = rows.by_ref().take(VALUES / width).collect();
            let places = (0..some.len()).map(|row| {
                let places: Vec<String> =
                    (1..=width).map(|column| format!("${}", row * width + column)).collect();
                format!("({})", places.join(", "))
            });
            let places: Vec<String> = places.collect();
            let write = format!("INSERT INTO {} ({}) VALUES {}", self.name, self.names(), places.join(", "));
            let query = some.into_iter().flatten().fold(sql(write), |query, value| query.bind(value));
            query.execute(&mut *session).await?;
        }
        Ok(())
    }
}

/// The tables as the session on SQLite has them.
async fn tables(sqlite: &mut Session) -> Result<Vec<Table>, StoreError> {
    let mut tables = Vec::with_capacity(TABLES.len());
    for (name, key) in TABLES {
        let columns: Vec<(String, String)> = sql("SELECT name, type FROM pragma_table_info($1) ORDER BY cid")
            .bind(name)
            .fetch_all(&mut *sqlite)
            .await?;
        let columns = columns.into_iter().map(|(name, kind)| Column { name, kind }).collect();
        tables.push(Table { name, key, columns });
    }
    Ok(tables)
}

/// Whether a registry has no row at all.
pub(super) async fn is_empty(session: &mut Session) -> Result<bool, StoreError> {
    for (table, _) in TABLES {
        let any: bool =
            sql(format!("SELECT EXISTS (SELECT 1 FROM {table})")).fetch_one(&mut *session).await?;
        if any {
            return Ok(false);
        }
    }
    Ok(true)
}

/// The two sessions of a transfer; one of them is on SQLite.
pub(super) struct Transfer<'a> {
    pub(super) from: &'a mut Session,
    pub(super) to: &'a mut Session,
}

impl Transfer<'_> {
    async fn tables(&mut self) -> Result<Vec<Table>, StoreError> {
        let sqlite = if self.from.is_sqlite() { &mut *self.from } else { &mut *self.to };
        tables(sqlite).await
    }

    /// Copies every row into an empty registry.
    pub(super) async fn copy(&mut self) -> Result<(), StoreError> {
        self.to.defer_references().await?;
        for table in self.tables().await? {
            for from in (0..).step_by(PAGE as usize) {
                let rows = table.rows(self.from, from).await?;
                if rows.is_empty() {
                    break;
                }
                table.insert(self.to, rows).await?;
            }
        }
        Ok(())
    }

    /// A table whose rows differ, if there is one.
    pub(super) async fn difference(&mut self) -> Result<Option<&'static str>, StoreError> {
        for table in self.tables().await? {
            for from in (0..).step_by(PAGE as usize) {
                let (one, other) = (table.rows(self.from, from).await?, table.rows(self.to, from).await?);
                if one != other {
                    return Ok(Some(table.name));
                }
                if one.is_empty() {
                    break;
                }
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::storage::testing::TestStore;

    /// Tables of SQLite that PostgreSQL has no need of.
    const OF_SQLITE: [&str; 3] = ["changes", "sqlite_sequence", "_sqlx_migrations"];

    #[tokio::test]
    async fn every_table_is_copied() {
        let store = TestStore::open_sqlite().await;
        let there: Vec<String> = sql("SELECT name FROM sqlite_master WHERE type = 'table'")
            .fetch_all(store.reader())
            .await
            .unwrap();
        let there: BTreeSet<&str> =
            there.iter().map(String::as_str).filter(|name| !OF_SQLITE.contains(name)).collect();
        assert_eq!(there, TABLES.map(|(name, _)| name).into());
    }

    #[tokio::test]
    async fn both_databases_have_the_same_columns() {
        let store = TestStore::open().await;
        if !store.is_shared() {
            println!("skipped: RIGCAST_TEST_DATABASE names no PostgreSQL");
            return;
        }
        let sqlite = TestStore::open_sqlite().await;
        for table in tables(&mut sqlite.snapshot().await.unwrap()).await.unwrap() {
            let wanted: BTreeSet<(String, &str)> = table
                .columns
                .into_iter()
                .map(|column| {
                    let kind = match column.kind.as_str() {
                        "TEXT" => "text",
                        "INTEGER" => "bigint",
                        "REAL" => "double precision",
                        "BLOB" => "bytea",
                        other => panic!("{other}"),
                    };
                    (column.name, kind)
                })
                .collect();
            let found: Vec<(String, String)> = sql(
                "SELECT column_name::text, data_type::text FROM information_schema.columns WHERE table_name = $1",
            )
            .bind(table.name)
            .fetch_all(store.reader())
            .await
            .unwrap();
            let found = found.iter().map(|(name, kind)| (name.clone(), kind.as_str())).collect();
            assert_eq!(wanted, found, "{}", table.name);
        }
    }
}
