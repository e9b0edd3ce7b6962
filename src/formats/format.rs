//! The formats of measurement files, and which one a file has by its first bytes.

/// Formats that are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Text with a header row.
    Csv,
    /// NumPy array.
    Npy,
    /// Archive of NumPy arrays.
    Npz,
    /// RPC III time history.
    Rpc3,
    /// Workspace of MATLAB, version 5.
    Mat,
    /// HDF5, which MAT of version 7.3 is too.
    Hdf5,
    /// Universal File Format, data sets 58.
    Uff58,
    /// Sample rate and channels by name.
    Json,
}

impl Format {
    /// Bytes that tell the format.
    pub const START: usize = 512;

    /// The format by the first [`Format::START`] bytes of a file; text where they tell nothing.
    ///
    /// # Errors
    /// The name of a format that is known and not read.
    pub fn detect(start: &[u8]) -> Result<Self, &'static str> {
        let text = start.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(start);
        let first_line =
            text.trim_ascii_start().split(|b| matches!(b, b'\r' | b'\n')).next().unwrap_or_default();
        if start.starts_with(b"\x93NUMPY") {
            Ok(Self::Npy)
        } else if start.starts_with(b"FORMAT\0") {
            Ok(Self::Rpc3)
        } else if start.starts_with(b"\xD0\xCF\x11\xE0") {
            Err("a workbook of Excel")
        } else if start.starts_with(b"PK\x03\x04") {
            if is_npz(start) { Ok(Self::Npz) } else { Err("a zip archive, such as a workbook of Excel") }
        } else if start.starts_with(b"\x89HDF\r\n") || start.starts_with(b"MATLAB 7.3 MAT-file") {
            Ok(Self::Hdf5)
        } else if start.starts_with(b"MATLAB ") {
            Ok(Self::Mat)
        } else if first_line.starts_with(b"{") {
            Ok(Self::Json)
        } else if first_line.trim_ascii() == b"-1" && text.starts_with(b" ") {
            Ok(Self::Uff58)
        } else {
            Ok(Self::Csv)
        }
    }

    /// The format by the ending of a file's name; none where programs use the ending for several formats.
    pub fn of_name(file_name: &str) -> Option<Self> {
        let ending = file_name.rsplit_once('.')?.1.to_ascii_lowercase();
        match ending.as_str() {
            "csv" => Some(Self::Csv),
            "npy" => Some(Self::Npy),
            "npz" => Some(Self::Npz),
            "rsp" | "drv" | "tim" => Some(Self::Rpc3),
            "mat" => Some(Self::Mat),
            "h5" | "hdf5" => Some(Self::Hdf5),
            "uff" | "unv" => Some(Self::Uff58),
            "json" => Some(Self::Json),
            _ => None,
        }
    }

    /// The format's name in answers and metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Npy => "npy",
            Self::Npz => "npz",
            Self::Mat => "mat",
            Self::Hdf5 => "hdf5",
            Self::Rpc3 => "rpc3",
            Self::Uff58 => "uff58",
            Self::Json => "json",
        }
    }
}

/// Whether the first entry of a zip archive is an array of NumPy.
fn is_npz(start: &[u8]) -> bool {
    let Some(&[low, high]) = start.get(26..28) else { return false };
    let name = start.get(30..30 + usize::from(u16::from_le_bytes([low, high])));
    name.is_some_and(|name| name.ends_with(b".npy"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ending_of_a_name_tells_the_format_whatever_its_case() {
        assert_eq!(Format::of_name("C:\\run.1.RSP"), Some(Format::Rpc3));
        assert_eq!(Format::of_name("noise.Csv"), Some(Format::Csv));
        for name in ["noise.txt", "noise.dat", "csv", "", "noise."] {
            assert_eq!(Format::of_name(name), None, "{name}");
        }
    }

    #[test]
    fn the_first_bytes_tell_the_format() {
        for (start, found) in [
            (&b"\x93NUMPY\x01\0"[..], Ok(Format::Npy)),
            (b"FORMAT\0\0\0", Ok(Format::Rpc3)),
            (b"    -1\n    58\n", Ok(Format::Uff58)),
            (b"\n    -1\r\n    58\r\n", Ok(Format::Csv)),
            (b"  \n{\"channels\"", Ok(Format::Json)),
            (b"\xEF\xBB\xBF{", Ok(Format::Json)),
            (b"PK\x03\x04", Err("a zip archive, such as a workbook of Excel")),
            (b"\xD0\xCF\x11\xE0\xA1", Err("a workbook of Excel")),
            (b"PK\x03\x04\x14\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x05\0\0\0u.npy", Ok(Format::Npz)),
            (b"MATLAB 5.0 MAT-file", Ok(Format::Mat)),
            (b"MATLAB 7.3 MAT-file", Ok(Format::Hdf5)),
            (b"\x89HDF\r\n\x1a\n", Ok(Format::Hdf5)),
            (b"u,y\n1,2\n", Ok(Format::Csv)),
            (b"-1\n2\n", Ok(Format::Csv)),
            (b"", Ok(Format::Csv)),
        ] {
            assert_eq!(Format::detect(start), found, "{}", String::from_utf8_lossy(start));
        }
    }
}
