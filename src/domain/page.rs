//! Lists in pages: `{"items": [...], "next": "cursor" | null}`.

use serde::Serialize;

/// Most items that a page may have.
pub const MAX_LIMIT: u32 = 1000;

/// Items of a page when the client does not say.
pub const DEFAULT_LIMIT: u32 = 100;

/// Key of the last item that a client has seen. Opaque to clients. It stays valid when items are added or
/// removed, because it names a place in the order and not a count.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cursor(String);

/// A cursor that is not valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("not a cursor of this list")]
pub struct CursorError;

impl Cursor {
    /// A cursor after the item with this key.
    pub(crate) fn after(key: impl ToString) -> Self {
        Self(key.to_string())
    }

    /// Reads a cursor from a query. Any text in the form of a key is accepted, since it is only compared.
    ///
    /// # Errors
    /// Text that cannot be a key.
    pub fn parse(text: &str) -> Result<Self, CursorError> {
        let fits = !text.is_empty()
            && text.len() <= 64
            && text.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
        if fits { Ok(Self(text.to_owned())) } else { Err(CursorError) }
    }

    /// The key as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// A request for a page.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PageRequest {
    /// Most items, 1..=[`MAX_LIMIT`].
    pub limit: u32,
    /// End of the previous page; `None`: the first page.
    pub cursor: Option<Cursor>,
}

impl Default for PageRequest {
    fn default() -> Self {
        Self { limit: DEFAULT_LIMIT, cursor: None }
    }
}

/// One page of a list.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Page<T> {
    /// The items, in the list's order.
    pub items: Vec<T>,
    /// Cursor of the next page, if there is one.
    pub next: Option<String>,
}

impl<T> Page<T> {
    /// Makes a page of `items`, of which one more than `limit` was asked for.
    pub(crate) fn cut(mut items: Vec<T>, limit: u32, key: impl Fn(&T) -> String) -> Self {
        let limit = limit as usize;
        let more = items.len() > limit;
        items.truncate(limit);
        let next = if more { items.last().map(|last| Cursor::after(key(last)).0) } else { None };
        Self { items, next }
    }

    /// The page with other items, as many as before.
    pub(crate) fn map<U>(self, make: impl FnMut(T) -> U) -> Page<U> {
        Page { items: self.items.into_iter().map(make).collect(), next: self.next }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_has_a_next_only_when_more_items_follow() {
        let page = Page::cut(vec![1, 2, 3], 2, i32::to_string);
        assert_eq!(page, Page { items: vec![1, 2], next: Some("2".into()) });
        let page = Page::cut(vec![1, 2], 2, i32::to_string);
        assert_eq!(page, Page { items: vec![1, 2], next: None });
    }

    #[test]
    fn a_cursor_that_no_key_can_be_is_refused() {
        assert_eq!(Cursor::parse("").unwrap_err(), CursorError);
        assert_eq!(Cursor::parse("a' OR 1=1").unwrap_err(), CursorError);
        assert_eq!(Cursor::parse("hydromount-3x").unwrap().as_str(), "hydromount-3x");
    }
}
