//! The tables whose rows are journaled, and the images of their rows.

use futures::StreamExt;
use futures::stream::BoxStream;
use sqlx::sqlite::SqliteRow;
use sqlx::{AssertSqlSafe, Column, Row, SqliteConnection, TypeInfo, ValueRef};

use super::entry::{Cell, Image, RowName};
use crate::storage::StoreError;
use crate::storage::objects::hex;

/// A journaled table.
#[derive(Debug, Clone, Copy)]
pub(super) struct Table {
    pub name: &'static str,
    pub key: &'static [&'static str],
}

/// In an order in which rows can be inserted.
pub(super) const TABLES: [Table; 11] = [
    Table { name: "rigs", key: &["id"] },
    Table { name: "models", key: &["rig", "version"] },
    Table { name: "fit_records", key: &["rig", "version"] },
    Table { name: "runs", key: &["id"] },
    Table { name: "jobs", key: &["id"] },
    Table { name: "diagnoses", key: &["id"] },
    Table { name: "iterations", key: &["id"] },
    Table { name: "evaluations", key: &["id"] },
    Table { name: "studies", key: &["job"] },
    Table { name: "tokens", key: &["id"] },
    Table { name: "idempotency_keys", key: &["owner", "key"] },
];

/// Columns of a job that a worker or the queue changes while it waits or runs. They are not journaled until it ends.
const PROGRESS: [&str; 13] = [
    "stage",
    "progress",
    "eta_s",
    "event",
    "worker",
    "lease_token",
    "lease_until_us",
    "started_us",
    "charged_us",
    "goes_on",
    "queued_us",
    "furthest",
    "service_deaths",
];

impl Table {
    /// The journaled table of this name.
    pub(super) fn named(name: &str) -> Option<Self> {
        TABLES.into_iter().find(|table| table.name == name)
    }

    fn bad(self, key: &str, what: impl ToString) -> StoreError {
        StoreError::Row { table: self.name, key: key.to_owned(), what: what.to_string() }
    }

    /// Every row that can be read, by name, in the order of the rows in the file.
    ///
    /// # Errors
    /// The database's failures, and values of a type that the schema does not have.
    pub(super) async fn rows(
        self,
        connection: &mut SqliteConnection,
    ) -> Result<Vec<(RowName, Image)>, StoreError> {
        let all = AssertSqlSafe(format!("SELECT * FROM {} ORDER BY rowid", self.name));
        let rows = sqlx::query(all).fetch_all(connection).await?;
        rows.iter().map(|row| self.read(row)).collect()
    }

    /// As [`Table::rows`], one row after the other.
    pub(super) fn stream(
        self,
        connection: &mut SqliteConnection,
    ) -> BoxStream<'_, Result<(RowName, Image), StoreError>> {
        let all = AssertSqlSafe(format!("SELECT * FROM {} ORDER BY rowid", self.name));
        let rows = sqlx::query(all).fetch(connection);
        rows.map(move |row| self.read(&row?)).boxed()
    }

    /// The row of this key (JSON), if it is there.
    ///
    /// # Errors
    /// As of [`Table::rows`].
    pub(super) async fn row(
        self,
        connection: &mut SqliteConnection,
        key: &str,
    ) -> Result<Option<Image>, StoreError> {
        let cells: Vec<Cell> = serde_json::from_str(key).map_err(|error| self.bad(key, error))?;
        let wanted: Vec<String> = self.key.iter().map(|column| format!("{column} = ?")).collect();
        let one = AssertSqlSafe(format!("SELECT * FROM {} WHERE {}", self.name, wanted.join(" AND ")));
        let mut query = sqlx::query(one);
        for cell in cells {
            query = bind(query, cell);
        }
        let row = query.fetch_optional(connection).await?;
        row.map(|row| self.read(&row).map(|(_, image)| image)).transpose()
    }

    /// Writes a row as its image says, whether it is there or not. Columns that the image lacks keep their value,
    /// or their default in a new row. Triggers must be off.
    ///
    /// # Errors
    /// The database's failures.
    pub(super) async fn put(
        self,
        connection: &mut SqliteConnection,
        image: &Image,
    ) -> Result<(), StoreError> {
        let columns: Vec<&str> = image.keys().map(String::as_str).collect();
        let places = vec!["?"; columns.len()].join(", ");
        let updates: Vec<String> =
            columns.iter().map(|column| format!("{column} = excluded.{column}")).collect();
        let upsert = format!(
            "INSERT INTO {} ({}) VALUES ({places}) ON CONFLICT ({}) DO UPDATE SET {}",
            self.name,
            columns.join(", "),
            self.key.join(", "),
            updates.join(", "),
        );
        let mut query = sqlx::query(AssertSqlSafe(upsert));
        for cell in image.values() {
            query = bind(query, cell.clone());
        }
        query.execute(connection).await?;
        Ok(())
    }

    fn read(self, row: &SqliteRow) -> Result<(RowName, Image), StoreError> {
        let mut image = Image::new();
        for column in row.columns() {
            let bad = |error: sqlx::Error| self.bad(column.name(), error);
            let i = column.ordinal();
            let value = row.try_get_raw(i).map_err(bad)?;
            let cell = match value.type_info().name() {
                _ if value.is_null() => Cell::Null,
                "INTEGER" => Cell::Int(row.try_get_unchecked(i).map_err(bad)?),
                "REAL" => Cell::Real(row.try_get_unchecked(i).map_err(bad)?),
                // Damage may have made it something else than UTF-8; it is compared all the same.
                "TEXT" => {
                    let text: Vec<u8> = row.try_get_unchecked(i).map_err(bad)?;
                    Cell::Text(String::from_utf8_lossy(&text).into_owned())
                }
                "BLOB" => Cell::Blob { blob: hex(&row.try_get_unchecked::<Vec<u8>, _>(i).map_err(bad)?) },
                other => return Err(self.bad(column.name(), format!("a value of type {other}"))),
            };
            image.insert(column.name().to_owned(), cell);
        }
        let key: Vec<Cell> =
            self.key.iter().map(|column| image.get(*column).cloned().unwrap_or(Cell::Null)).collect();
        let key = serde_json::to_string(&key).expect("keys are texts and integers");
        if self.name == "jobs" && under_way(&image) {
            image.retain(|column, _| !PROGRESS.contains(&column.as_str()));
        }
        Ok((RowName { table: self.name.to_owned(), key }, image))
    }
}

/// Whether a job waits or runs.
fn under_way(job: &Image) -> bool {
    job.get("state")
        .is_some_and(|state| matches!(state, Cell::Text(word) if word == "queued" || word == "running"))
}

type Query<'q> = sqlx::query::Query<'q, sqlx::Sqlite, sqlx::sqlite::SqliteArguments>;

fn bind(query: Query<'_>, cell: Cell) -> Query<'_> {
    match cell {
        Cell::Null => query.bind(None::<i64>),
        Cell::Int(number) => query.bind(number),
        Cell::Real(number) => query.bind(number),
        Cell::Text(text) => query.bind(text),
        Cell::Blob { blob } => query.bind(bytes(&blob)),
    }
}

/// Bytes from hex digits. Lines are read only if their checksum holds, so the digits are ours.
fn bytes(hex: &str) -> Vec<u8> {
    let digit = |c: u8| (c as char).to_digit(16).unwrap_or_default() as u8;
    hex.as_bytes().chunks_exact(2).map(|pair| 16 * digit(pair[0]) + digit(pair[1])).collect()
}
