//! The registry's database: SQLite in the data directory, or PostgreSQL for any number of machines.
//!
//! Statements are the same for both, with `$1`, `$2` and so on for their values; the few that differ have a form for
//! each. A row is read column by column, so that one damaged value fails its own row and no other.

pub(super) mod postgres;
mod row;
pub(super) mod sqlite;
mod statement;

use sqlx::{PgPool, SqlitePool};

pub use postgres::PostgresSettings;
pub(super) use row::{FromRow, Row};
pub(super) use statement::{On, Session, Sql, Value, either, sql};

/// Connections to one of the databases.
#[derive(Debug, Clone)]
pub(super) enum Pool {
    Sqlite(SqlitePool),
    Postgres(PgPool),
}

impl Pool {
    /// Begins a transaction that writes, so that rows that it reads cannot change before it writes: one at a time in
    /// the whole database.
    pub(super) async fn write(&self) -> sqlx::Result<Session> {
        match self {
            Self::Sqlite(pool) => sqlite::write(pool).await.map(Session::Sqlite),
            Self::Postgres(pool) => {
                let mut session = Session::Postgres(postgres::answered(Box::pin(pool.begin())).await?);
                postgres::write_alone(&mut session).await?;
                Ok(session)
            }
        }
    }

    /// Begins a transaction that reads all its rows as of one moment.
    pub(super) async fn snapshot(&self) -> sqlx::Result<Session> {
        match self {
            Self::Sqlite(pool) => pool.begin().await.map(Session::Sqlite),
            Self::Postgres(pool) => {
                const BEGIN: &str = "BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY";
                postgres::answered(Box::pin(pool.begin_with(BEGIN))).await.map(Session::Postgres)
            }
        }
    }

    /// Closes all connections.
    pub(super) async fn close(&self) {
        match self {
            Self::Sqlite(pool) => pool.close().await,
            Self::Postgres(pool) => pool.close().await,
        }
    }
}

impl Session {
    /// Whether it is on SQLite.
    pub(super) fn is_sqlite(&self) -> bool {
        matches!(self, Self::Sqlite(_))
    }

    /// Checks references between rows at the end of the transaction only.
    pub(super) async fn defer_references(&mut self) -> sqlx::Result<()> {
        let defer = either("PRAGMA defer_foreign_keys = ON", "SET CONSTRAINTS ALL DEFERRED");
        sql(defer).execute(self).await.map(drop)
    }

    /// Commits. Dropping a session takes its writes back.
    pub(super) async fn commit(self) -> sqlx::Result<()> {
        match self {
            Self::Sqlite(tx) => tx.commit().await,
            Self::Postgres(tx) => postgres::answered(Box::pin(tx.commit())).await,
        }
    }
}
