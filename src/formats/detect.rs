//! The format of a measurement file by its first bytes.

/// Bytes that tell the format.
pub const BYTES: usize = 512;

/// Formats that their first bytes tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Detected {
    /// NumPy array.
    Npy,
    /// RPC III time history.
    Rpc3,
    /// Universal File Format.
    Uff58,
    /// A JSON object.
    Json,
    /// A format that is known and not read, by its name.
    NotRead(&'static str),
    /// Text, or a format that is not known.
    Other,
}

/// The format by the first [`BYTES`] bytes of a file.
pub fn detect(start: &[u8]) -> Detected {
    let text = start.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(start);
    let first_line = text.trim_ascii_start().split(|b| matches!(b, b'\r' | b'\n')).next().unwrap_or_default();
    if start.starts_with(b"\x93NUMPY") {
        Detected::Npy
    } else if start.starts_with(b"FORMAT\0") {
        Detected::Rpc3
    } else if start.starts_with(b"\xD0\xCF\x11\xE0") {
        Detected::NotRead("a workbook of Excel")
    } else if start.starts_with(b"PK\x03\x04") {
        Detected::NotRead("a zip archive, such as a workbook of Excel")
    } else if start.starts_with(b"MATLAB ") {
        Detected::NotRead("a MAT file")
    } else if start.starts_with(b"\x89HDF\r\n") {
        Detected::NotRead("an HDF5 file")
    } else if first_line.starts_with(b"{") {
        Detected::Json
    } else if first_line.trim_ascii() == b"-1" && text.starts_with(b" ") {
        Detected::Uff58
    } else {
        Detected::Other
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_bytes_tell_the_format() {
        for (start, found) in [
            (&b"\x93NUMPY\x01\0"[..], Detected::Npy),
            (b"FORMAT\0\0\0", Detected::Rpc3),
            (b"    -1\n    58\n", Detected::Uff58),
            (b"\n    -1\r\n    58\r\n", Detected::Other),
            (b"  \n{\"channels\"", Detected::Json),
            (b"\xEF\xBB\xBF{", Detected::Json),
            (b"PK\x03\x04", Detected::NotRead("a zip archive, such as a workbook of Excel")),
            (b"\xD0\xCF\x11\xE0\xA1", Detected::NotRead("a workbook of Excel")),
            (b"MATLAB 5.0 MAT-file", Detected::NotRead("a MAT file")),
            (b"\x89HDF\r\n\x1a\n", Detected::NotRead("an HDF5 file")),
            (b"u,y\n1,2\n", Detected::Other),
            (b"-1\n2\n", Detected::Other),
            (b"", Detected::Other),
        ] {
            assert_eq!(detect(start), found, "{}", String::from_utf8_lossy(start));
        }
    }
}
