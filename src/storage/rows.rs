//! From rows to the domain's types and back.
