//! The lines of a text file, gzipped or not, whatever bytes it holds.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read as _};
use std::path::Path;

use flate2::bufread::MultiGzDecoder;
use thiserror::Error;

use crate::slam::scan::GeometryError;

/// A longer line is passed over: the longest real sweeps have a few thousand beams.
const LONGEST_LINE: u64 = 1 << 20;

/// The first two bytes of every gzip file (RFC 1952).
const GZIP_MAGIC: [u8; 2] = [0x1f, 0x8b];

/// What is wrong with a line.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum LineError {
    /// It has another number of fields than its kind and its own counts ask for.
    #[error("has {found} fields where {expected} are needed")]
    FieldCount {
        /// Fields there should be, the keyword included.
        expected: usize,
        /// Fields there are.
        found: usize,
    },
    /// A field is not a number.
    #[error("{field} is {text:?}, which is not a number")]
    NotANumber {
        /// What the field means.
        field: &'static str,
        /// What it holds.
        text: String,
    },
    /// A field is NaN or infinite.
    #[error("{field} is {value}, which is not finite")]
    NotFinite {
        /// What the field means.
        field: &'static str,
        /// Its value.
        value: f64,
    },
    /// The sweep has no beams.
    #[error("its sweep has no beams")]
    NoBeams,
    /// The sweep's angles or limits cannot be.
    #[error(transparent)]
    Geometry(#[from] GeometryError),
    /// It is not UTF-8.
    #[error("is not text")]
    NotText,
    /// It does not end.
    #[error("is longer than {LONGEST_LINE} bytes")]
    TooLong,
    /// The gzip stream stops in the middle.
    #[error("the compressed file is cut off here")]
    CutOff,
}

/// Reads one line after the other into one buffer.
pub(super) struct Lines {
    reader: Box<dyn BufRead>,
    buffer: Vec<u8>,
    number: u64,
    cut_off: bool,
}

impl Lines {
    /// The lines of a file; gzip is recognised by its first bytes.
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let mut file = BufReader::with_capacity(1 << 16, File::open(path)?);
        let gzipped = file.fill_buf()?.starts_with(&GZIP_MAGIC);
        Ok(if gzipped {
            Self::new(Box::new(BufReader::new(MultiGzDecoder::new(file))))
        } else {
            Self::new(Box::new(file))
        })
    }

    /// The lines of anything that can be read.
    pub(super) fn new(reader: Box<dyn BufRead>) -> Self {
        Self { reader, buffer: Vec::new(), number: 0, cut_off: false }
    }

    /// The number of the line read last, from 1.
    pub(super) const fn number(&self) -> u64 {
        self.number
    }

    /// The next line, or what is wrong with it; `None` at the end.
    pub(super) fn next(&mut self) -> io::Result<Option<Result<&str, LineError>>> {
        self.buffer.clear();
        if self.cut_off {
            return Ok(None);
        }
        match self.read_line() {
            Ok(0) => return Ok(None),
            Ok(_) => self.number += 1,
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
                self.cut_off = true;
                self.number += 1;
                return Ok(Some(Err(LineError::CutOff)));
            }
            Err(error) => return Err(error),
        }
        if self.buffer.len() as u64 == LONGEST_LINE && self.buffer.last() != Some(&b'\n') {
            self.reader.skip_until(b'\n')?;
            return Ok(Some(Err(LineError::TooLong)));
        }
        let text = std::str::from_utf8(&self.buffer).ok().ok_or(LineError::NotText);
        Ok(Some(text))
    }

    fn read_line(&mut self) -> io::Result<usize> {
        self.reader.by_ref().take(LONGEST_LINE).read_until(b'\n', &mut self.buffer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines_of(bytes: &'static [u8]) -> Vec<Result<String, LineError>> {
        let mut lines = Lines::new(Box::new(bytes));
        let mut all = Vec::new();
        while let Some(line) = lines.next().unwrap() {
            all.push(line.map(str::to_owned));
        }
        all
    }

    #[test]
    fn the_last_line_needs_no_newline() {
        assert_eq!(lines_of(b"a\nb"), [Ok("a\n".to_owned()), Ok("b".to_owned())]);
    }

    #[test]
    fn bytes_that_are_no_text_are_reported_and_passed_over() {
        assert_eq!(lines_of(b"\xff\xfe\nb"), [Err(LineError::NotText), Ok("b".to_owned())]);
    }

    #[test]
    fn a_line_without_end_is_passed_over_in_bounded_memory() {
        let endless: &'static [u8] = Box::leak(vec![b'x'; 3 << 20].into_boxed_slice());
        let mut lines = Lines::new(Box::new(endless.chain(&b"\nb"[..])));
        assert_eq!(lines.next().unwrap(), Some(Err(LineError::TooLong)));
        assert_eq!(lines.next().unwrap(), Some(Ok("b")));
        assert!(lines.buffer.capacity() < 4 << 20);
    }
}
