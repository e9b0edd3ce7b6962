//! Rows of either database, read column by column.

use sqlx::postgres::PgRow;
use sqlx::sqlite::SqliteRow;
use sqlx::{ColumnIndex, Row as _, TypeInfo as _, ValueRef as _};

use super::statement::Value;

/// A row.
pub(in crate::storage) enum Row {
    Sqlite(SqliteRow),
    Postgres(PgRow),
}

/// The name or the place of a column.
pub(in crate::storage) trait At:
    ColumnIndex<SqliteRow> + ColumnIndex<PgRow> + Copy + ToString
{
}

impl At for &str {}
impl At for usize {}

impl Row {
    /// A column's value. One of another type is an error of the whole row, which names the column.
    pub(in crate::storage) fn get<T: Column>(&self, at: impl At) -> sqlx::Result<T> {
        T::read(self, at)
    }

    /// Number of its columns.
    pub(in crate::storage) fn len(&self) -> usize {
        match self {
            Self::Sqlite(row) => row.len(),
            Self::Postgres(row) => row.len(),
        }
    }

    /// A column's value as it is; NULL as that of a text.
    pub(in crate::storage) fn value(&self, at: usize) -> sqlx::Result<Value> {
        let (kind, is_null) = match self {
            Self::Sqlite(row) => {
                let raw = row.try_get_raw(at)?;
                (raw.type_info().name().to_owned(), raw.is_null())
            }
            Self::Postgres(row) => {
                let raw = row.try_get_raw(at)?;
                (raw.type_info().name().to_owned(), raw.is_null())
            }
        };
        if is_null {
            return Ok(Value::Text(None));
        }
        Ok(match kind.as_str() {
            "INTEGER" | "INT8" => Value::Int(self.get(at)?),
            "REAL" | "FLOAT8" => Value::Real(self.get(at)?),
            "BLOB" | "BYTEA" => Value::Bytes(self.get(at)?),
            _ => Value::Text(self.get(at)?),
        })
    }
}

/// What a column may hold.
pub(in crate::storage) trait Column: Sized {
    fn read(row: &Row, at: impl At) -> sqlx::Result<Self>;
}

macro_rules! column {
    ($($type:ty),+) => {
        $(
            impl Column for $type {
                fn read(row: &Row, at: impl At) -> sqlx::Result<Self> {
                    match row {
                        Row::Sqlite(row) => row.try_get(at),
                        Row::Postgres(row) => row.try_get(at),
                    }
                }
            }
        )+
    };
}

column!(String, f64, Vec<u8>, Option<String>, Option<f64>, Option<Vec<u8>>);

macro_rules! number {
    ($($type:ty),+) => {
        $(
            impl Column for Option<$type> {
                fn read(row: &Row, at: impl At) -> sqlx::Result<Self> {
                    match row {
                        Row::Sqlite(row) => row.try_get(at),
                        Row::Postgres(row) => number(row, at)?.map(|n| n.try_into().map_err(|_| misfit(at))).transpose(),
                    }
                }
            }

            impl Column for $type {
                fn read(row: &Row, at: impl At) -> sqlx::Result<Self> {
                    Option::read(row, at)?.ok_or_else(|| misfit(at))
                }
            }
        )+
    };
}

number!(i64, u32, u16);

impl Column for bool {
    fn read(row: &Row, at: impl At) -> sqlx::Result<Self> {
        match row {
            Row::Sqlite(row) => row.try_get(at),
            Row::Postgres(row) => Ok(number(row, at)?.ok_or_else(|| misfit(at))? != 0),
        }
    }
}

/// PostgreSQL's whole numbers: columns and counts have 64 bits, literals 32, and comparisons are truth values.
fn number(row: &PgRow, at: impl At) -> sqlx::Result<Option<i64>> {
    match row.try_get_raw(at)?.type_info().name() {
        "BOOL" => Ok(row.try_get::<Option<bool>, _>(at)?.map(i64::from)),
        "INT4" => Ok(row.try_get::<Option<i32>, _>(at)?.map(i64::from)),
        _ => row.try_get(at),
    }
}

fn misfit(at: impl At) -> sqlx::Error {
    let source = "NULL, or a number out of range".into();
    sqlx::Error::ColumnDecode { index: format!("{:?}", at.to_string()), source }
}

/// What is made of a whole row.
pub(in crate::storage) trait FromRow: Sized {
    fn from_row(row: &Row) -> sqlx::Result<Self>;
}

/// A row of one column.
macro_rules! scalar {
    ($($type:ty),+) => {
        $(
            impl FromRow for $type {
                fn from_row(row: &Row) -> sqlx::Result<Self> {
                    row.get(0)
                }
            }
        )+
    };
}

scalar!(String, i64, u32, f64, bool, Option<String>, Option<i64>, Option<f64>);

macro_rules! tuple {
    ($($column:ident $at:literal),+) => {
        impl<$($column: Column),+> FromRow for ($($column,)+) {
            fn from_row(row: &Row) -> sqlx::Result<Self> {
                Ok(($(row.get::<$column>($at)?,)+))
            }
        }
    };
}

tuple!(A 0, B 1);
tuple!(A 0, B 1, C 2);
tuple!(A 0, B 1, C 2, D 3);
tuple!(A 0, B 1, C 2, D 3, E 4);
tuple!(A 0, B 1, C 2, D 3, E 4, F 5);
