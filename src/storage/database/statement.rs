//! Statements with their values, on either database.

use bytes::Bytes;
use sqlx::postgres::PgArguments;
use sqlx::sqlite::SqliteArguments;
use sqlx::{Arguments, AssertSqlSafe, Postgres, SqlSafeStr as _, SqlStr, Sqlite, Transaction};

use super::Pool;
use super::postgres::answered;
use super::row::{FromRow, Row};

/// A value of a parameter or a column, of the type of its column, `None` being NULL.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::storage) enum Value {
    Text(Option<String>),
    Int(Option<i64>),
    Real(Option<f64>),
    Bytes(Option<Vec<u8>>),
}

macro_rules! value {
    ($($kind:ident: $($from:ty => $make:expr),+;)+) => {
        $($(
            impl From<$from> for Value {
                fn from(value: $from) -> Self {
                    let make: fn($from) -> _ = $make;
                    Self::$kind(Some(make(value)))
                }
            }

            impl From<Option<$from>> for Value {
                fn from(value: Option<$from>) -> Self {
                    Self::$kind(value.map($make))
                }
            }
        )+)+
    };
}

// Truth values are 0 and 1 in both databases.
value! {
    Text: String => |text| text, &str => str::to_owned, &String => String::clone;
    Int: i64 => |n| n, u32 => i64::from, bool => i64::from;
    Real: f64 => |x| x;
    Bytes: &[u8] => <[u8]>::to_vec, &Bytes => |bytes| bytes.to_vec();
}

impl Value {
    /// The value, or NULL of a column of this type of SQLite.
    pub(in crate::storage) fn or_null_of(self, kind: &str) -> Self {
        match (&self, kind) {
            (Self::Text(None), "INTEGER") => Self::Int(None),
            (Self::Text(None), "REAL") => Self::Real(None),
            (Self::Text(None), "BLOB") => Self::Bytes(None),
            _ => self,
        }
    }
}

/// The text of a statement, which is the same for both databases or has a form for each.
#[derive(Debug, Clone)]
pub(in crate::storage) enum Sql {
    /// The same for both.
    Both(&'static str),
    /// Made of names that this program knows, never of what a client sends.
    Made(String),
    /// One for each.
    Either { sqlite: &'static str, postgres: &'static str },
}

impl Sql {
    fn sqlite(self) -> SqlStr {
        match self {
            Self::Both(text) | Self::Either { sqlite: text, .. } => text.into_sql_str(),
            Self::Made(text) => AssertSqlSafe(text).into_sql_str(),
        }
    }

    fn postgres(self) -> SqlStr {
        match self {
            Self::Both(text) | Self::Either { postgres: text, .. } => text.into_sql_str(),
            Self::Made(text) => AssertSqlSafe(text).into_sql_str(),
        }
    }
}

impl From<&'static str> for Sql {
    fn from(both: &'static str) -> Self {
        Self::Both(both)
    }
}

impl From<String> for Sql {
    fn from(made: String) -> Self {
        Self::Made(made)
    }
}

/// A statement that the databases write differently.
pub(in crate::storage) const fn either(sqlite: &'static str, postgres: &'static str) -> Sql {
    Sql::Either { sqlite, postgres }
}

/// A statement and the values of its parameters `$1`, `$2` and so on.
#[must_use]
pub(in crate::storage) struct Query {
    sql: Sql,
    values: Vec<Value>,
}

/// A statement without values.
pub(in crate::storage) fn sql(text: impl Into<Sql>) -> Query {
    Query { sql: text.into(), values: Vec::new() }
}

/// A transaction.
pub(in crate::storage) enum Session {
    Sqlite(Transaction<'static, Sqlite>),
    Postgres(Transaction<'static, Postgres>),
}

/// Where a statement is done.
pub(in crate::storage) enum On<'a> {
    Pool(&'a Pool),
    Session(&'a mut Session),
}

impl<'a> From<&'a Pool> for On<'a> {
    fn from(pool: &'a Pool) -> Self {
        Self::Pool(pool)
    }
}

impl<'a> From<&'a mut Session> for On<'a> {
    fn from(session: &'a mut Session) -> Self {
        Self::Session(session)
    }
}

/// Does a statement on whichever database it is for.
macro_rules! done {
    ($query:ident, $on:ident, $method:ident, $sqlite:expr, $postgres:expr) => {{
        let Query { sql, values } = $query;
        match $on.into() {
            On::Pool(Pool::Sqlite(pool)) => {
                $sqlite(sqlx::query_with(sql.sqlite(), for_sqlite(values)?).$method(pool).await?)
            }
            On::Session(Session::Sqlite(tx)) => {
                $sqlite(sqlx::query_with(sql.sqlite(), for_sqlite(values)?).$method(&mut **tx).await?)
            }
            On::Pool(Pool::Postgres(pool)) => {
                let query = sqlx::query_with(sql.postgres(), for_postgres(values)?);
                $postgres(answered(Box::pin(query.$method(pool))).await?)
            }
            On::Session(Session::Postgres(tx)) => {
                let query = sqlx::query_with(sql.postgres(), for_postgres(values)?);
                $postgres(answered(Box::pin(query.$method(&mut **tx))).await?)
            }
        }
    }};
}

impl Query {
    /// Gives the next parameter its value.
    pub(in crate::storage) fn bind(mut self, value: impl Into<Value>) -> Self {
        self.values.push(value.into());
        self
    }

    /// Does it, and says how many rows were changed.
    pub(in crate::storage) async fn execute<'a>(self, on: impl Into<On<'a>>) -> sqlx::Result<u64> {
        use sqlx::postgres::PgQueryResult;
        use sqlx::sqlite::SqliteQueryResult;
        Ok(done!(self, on, execute, |done: SqliteQueryResult| done.rows_affected(), |done: PgQueryResult| {
            done.rows_affected()
        }))
    }

    /// All its rows.
    pub(in crate::storage) async fn fetch_all<'a, T: FromRow>(
        self,
        on: impl Into<On<'a>>,
    ) -> sqlx::Result<Vec<T>> {
        use sqlx::postgres::PgRow;
        use sqlx::sqlite::SqliteRow;
        done!(
            self,
            on,
            fetch_all,
            |rows: Vec<SqliteRow>| rows.into_iter().map(|row| T::from_row(&Row::Sqlite(row))).collect(),
            |rows: Vec<PgRow>| rows.into_iter().map(|row| T::from_row(&Row::Postgres(row))).collect()
        )
    }

    /// Its first row, if there is one.
    pub(in crate::storage) async fn fetch_optional<'a, T: FromRow>(
        self,
        on: impl Into<On<'a>>,
    ) -> sqlx::Result<Option<T>> {
        let row =
            done!(self, on, fetch_optional, |row: Option<_>| row.map(Row::Sqlite), |row: Option<_>| row
                .map(Row::Postgres));
        row.map(|row| T::from_row(&row)).transpose()
    }

    /// Its first row, which must be there.
    pub(in crate::storage) async fn fetch_one<'a, T: FromRow>(
        self,
        on: impl Into<On<'a>>,
    ) -> sqlx::Result<T> {
        self.fetch_optional(on).await?.ok_or(sqlx::Error::RowNotFound)
    }
}

fn for_sqlite(values: Vec<Value>) -> sqlx::Result<SqliteArguments> {
    let mut arguments = SqliteArguments::default();
    add_all(&mut arguments, values)?;
    Ok(arguments)
}

fn for_postgres(values: Vec<Value>) -> sqlx::Result<PgArguments> {
    let mut arguments = PgArguments::default();
    add_all(&mut arguments, values)?;
    Ok(arguments)
}

fn add_all<A>(arguments: &mut A, values: Vec<Value>) -> sqlx::Result<()>
where
    A: Arguments,
    for<'q> Option<String>: sqlx::Encode<'q, A::Database> + sqlx::Type<A::Database>,
    for<'q> Option<i64>: sqlx::Encode<'q, A::Database> + sqlx::Type<A::Database>,
    for<'q> Option<f64>: sqlx::Encode<'q, A::Database> + sqlx::Type<A::Database>,
    for<'q> Option<Vec<u8>>: sqlx::Encode<'q, A::Database> + sqlx::Type<A::Database>,
{
    for value in values {
        let added = match value {
            Value::Text(text) => arguments.add(text),
            Value::Int(number) => arguments.add(number),
            Value::Real(number) => arguments.add(number),
            Value::Bytes(bytes) => arguments.add(bytes),
        };
        added.map_err(sqlx::Error::Encode)?;
    }
    Ok(())
}
