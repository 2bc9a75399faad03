//! One `.npz` file: [`export_npz`].
//!
//! An npz is a zip of `.npy` files, each an array in one piece, and transitions come row by row. So every array is
//! first collected in a nameless temporary file beside the export, and these are then joined: memory holds a buffer
//! an array, and the disk, for a moment, twice the file's size. Nothing is compressed, since random floats hardly
//! shrink and what is stored plainly is read fastest.

use super::episodes::{Episode, each_episode};
use super::{ExportError, Exported, Target};
use crate::error::StoreError;
use getup_proto::{Rows, RunSpec, Segment, columns};
use std::fs::File;
use std::io::{self, BufWriter, Seek, Write};
use std::path::Path;
use zip::write::{SimpleFileOptions, ZipWriter};

/// Collected of an array before it goes to its file, in bytes.
const BUFFER_BYTES: usize = 1 << 16;

/// Writes the transitions to the file `path`, which `numpy.load` reads. Folders above it are created. Of N
/// transitions, W the width of a column:
///
/// | array | shape | type | |
/// | --- | --- | --- | --- |
/// | each column | N × W | float32 | its row of the step: of a state, the one before it |
/// | `next_` and its name | N × W | float32 | the state after the step, of columns that have one |
/// | `terminal` | N | bool | the step ended the episode in a terminal state, worth nothing more |
/// | `truncated` | N | bool | the step ended the episode at its time limit |
/// | `episode` | N | int64 | index of the episode in the export |
/// | `step` | N | int64 | index of the step in its episode, limp steps included |
/// | `writer`, `lane` | N | uint64, uint32 | who played it |
/// | `stage` | N | uint32 | the curriculum's stage |
///
/// The rows of an episode stand together, in order. Which episodes there are says [`Exported`].
///
/// `segments`: in the log's order, following `spec`. `progress` is told how many transitions were read and written
/// so far, after each episode; joining the arrays at the end takes about as long as writing the file once.
///
/// # Errors
/// [`ExportError`]; then there is no file.
pub fn export_npz(
    path: &Path,
    spec: &RunSpec,
    segments: impl Iterator<Item = Result<Segment, StoreError>>,
    progress: impl FnMut(u64),
) -> Result<Exported, ExportError> {
    let own = Content::OWN.map(|content| content.name(spec));
    if let Some(column) = own.into_iter().find(|name| spec.column(name).is_some()) {
        return Err(ExportError::Reserved { path: path.to_owned(), column });
    }
    let target = Target::new(path)?;
    let contents = Content::all(spec).into_iter();
    let mut arrays: Vec<Array> =
        contents.map(|content| Array::new(content, &target)).collect::<Result<_, _>>()?;
    let mut index = 0;
    let write = |episode: &Episode| {
        let write = |array: &mut Array| array.content.write(spec, episode, index, &mut array.spool);
        arrays.iter_mut().try_for_each(write).map_err(ExportError::io("write", &target.folder))?;
        index += 1;
        Ok(())
    };
    let exported = each_episode(spec, segments, write, progress)?;
    if exported.transitions == 0 {
        return Err(ExportError::Empty { path: path.to_owned() });
    }
    let mut file = target.partial_file()?;
    join(arrays, spec, exported.transitions, file.as_file_mut()).map_err(ExportError::io("write", path))?;
    target.keep_file(file)?;
    Ok(exported)
}

/// What an array holds.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Content {
    /// A column, by its index in the spec.
    Column(usize),
    /// The same, after the step.
    Next(usize),
    Terminal,
    Truncated,
    Episode,
    Step,
    Writer,
    Lane,
    Stage,
}

impl Content {
    /// Those that no column of the spec fills.
    const OWN: [Self; 7] =
        [Self::Terminal, Self::Truncated, Self::Episode, Self::Step, Self::Writer, Self::Lane, Self::Stage];

    fn all(spec: &RunSpec) -> Vec<Self> {
        let columns = 0..spec.columns.len();
        let next = columns.clone().filter(|&index| spec.columns[index].rows == Rows::StepsPlusOne);
        columns.map(Self::Column).chain(next.map(Self::Next)).chain(Self::OWN).collect()
    }

    /// The array's name in the npz.
    fn name(self, spec: &RunSpec) -> String {
        let own = match self {
            Self::Column(index) => return spec.columns[index].name.clone(),
            Self::Next(index) => return format!("{}{}", columns::NEXT_PREFIX, spec.columns[index].name),
            Self::Terminal => "terminal",
            Self::Truncated => "truncated",
            Self::Episode => "episode",
            Self::Step => "step",
            Self::Writer => "writer",
            Self::Lane => "lane",
            Self::Stage => "stage",
        };
        own.to_owned()
    }

    /// The type of its values, as NumPy writes it.
    fn descr(self) -> &'static str {
        match self {
            Self::Column(_) | Self::Next(_) => "<f4",
            Self::Terminal | Self::Truncated => "|b1",
            Self::Episode | Self::Step => "<i8",
            Self::Writer => "<u8",
            Self::Lane | Self::Stage => "<u4",
        }
    }

    /// Values a row, where an array has two dimensions.
    fn width(self, spec: &RunSpec) -> Option<usize> {
        match self {
            Self::Column(index) | Self::Next(index) => Some(spec.columns[index].width),
            _ => None,
        }
    }

    /// Writes the episode's rows; it has this `index` in the export.
    fn write(self, spec: &RunSpec, episode: &Episode, index: i64, out: &mut impl Write) -> io::Result<()> {
        let segments = episode.segments();
        // One value a step, the same in all of a segment.
        let mut repeat =
            |segment: &Segment, value: &[u8]| (0..segment.steps).try_for_each(|_| out.write_all(value));
        match self {
            Self::Column(column) => episode.write_rows(column, &spec.columns[column], out),
            Self::Next(column) => episode.write_next_rows(column, &spec.columns[column], out),
            Self::Terminal => segments.iter().try_for_each(|s| write_flag(s.steps, s.terminal, out)),
            Self::Truncated => segments.iter().try_for_each(|s| write_flag(s.steps, s.truncated, out)),
            Self::Episode => segments.iter().try_for_each(|s| repeat(s, &index.to_le_bytes())),
            Self::Step => {
                let first = i64::from(episode.first().first_step);
                (first..).take(episode.steps()).try_for_each(|step| out.write_all(&step.to_le_bytes()))
            }
            Self::Writer => segments.iter().try_for_each(|s| repeat(s, &s.writer.to_le_bytes())),
            Self::Lane => segments.iter().try_for_each(|s| repeat(s, &s.lane.to_le_bytes())),
            Self::Stage => segments.iter().try_for_each(|s| repeat(s, &s.stage.to_le_bytes())),
        }
    }
}

/// Writes false for all steps but the last, and `last` for that one.
fn write_flag(steps: usize, last: bool, out: &mut impl Write) -> io::Result<()> {
    (1..=steps).try_for_each(|step| out.write_all(&[u8::from(last && step == steps)]))
}

/// An array that is being collected.
struct Array {
    content: Content,
    /// Its values; has no name, so that nothing is left of it however the export ends.
    spool: BufWriter<File>,
}

impl Array {
    fn new(content: Content, target: &Target) -> Result<Self, ExportError> {
        let file = tempfile::tempfile_in(&target.folder)
            .map_err(ExportError::io("create a file in", &target.folder))?;
        Ok(Self { content, spool: BufWriter::with_capacity(BUFFER_BYTES, file) })
    }
}

/// Puts the arrays into one npz.
fn join(arrays: Vec<Array>, spec: &RunSpec, transitions: u64, file: &mut File) -> io::Result<()> {
    let mut zip = ZipWriter::new(BufWriter::with_capacity(BUFFER_BYTES, file));
    // Large: an array may exceed 4 GiB, and NumPy writes its own like this.
    let options =
        SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored).large_file(true);
    // Each array's own file goes with it, so that its space is free for the next.
    for array in arrays {
        let Array { content, spool } = array;
        zip.start_file(format!("{}.npy", content.name(spec)), options)?;
        zip.write_all(&npy_header(content.descr(), transitions, content.width(spec)))?;
        let mut spool = spool.into_inner().map_err(io::IntoInnerError::into_error)?;
        spool.rewind()?;
        io::copy(&mut spool, &mut zip)?;
    }
    zip.finish()?.flush()
}

/// What a `.npy` file begins with, in version 1.0 of the format: so many rows, C order.
fn npy_header(descr: &str, rows: u64, width: Option<usize>) -> Vec<u8> {
    const MAGIC: &[u8] = b"\x93NUMPY\x01\x00";
    const LENGTH_BYTES: usize = 2;
    // The values begin at a multiple of it.
    const ALIGNMENT: usize = 64;
    let width = width.map_or(String::new(), |width| format!(" {width}"));
    let mut text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({rows},{width}), }}");
    let fixed = MAGIC.len() + LENGTH_BYTES + text.len() + 1;
    text.extend(std::iter::repeat_n(' ', fixed.next_multiple_of(ALIGNMENT) - fixed));
    text.push('\n');
    let length = u16::try_from(text.len()).expect("a few numbers are shorter than 64 KiB");
    [MAGIC, &length.to_le_bytes(), text.as_bytes()].concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{self, Ending, Part};
    use std::io::Read;

    #[test]
    fn an_npy_header_is_aligned_and_says_the_shape() {
        for rows in [0, 1, 999_999_999_999] {
            for width in [None, Some(1), Some(1 << 20)] {
                let header = npy_header("<f4", rows, width);
                assert_eq!(header.len() % 64, 0);
                assert_eq!(usize::from(u16::from_le_bytes([header[8], header[9]])), header.len() - 10);
                assert_eq!(header.last(), Some(&b'\n'));
            }
        }
        let text = |width| String::from_utf8(npy_header("|b1", 7, width)[10..].to_vec()).unwrap();
        assert_eq!(text(None).trim_end(), "{'descr': '|b1', 'fortran_order': False, 'shape': (7,), }");
        assert!(text(Some(3)).contains("'shape': (7, 3), }"));
    }

    #[test]
    fn the_arrays_are_the_columns_the_next_states_and_where_they_come_from() {
        let spec = fixtures::spec(4);
        let names: Vec<_> = Content::all(&spec).into_iter().map(|content| content.name(&spec)).collect();
        let expected = "observation action reward beta next_observation terminal truncated episode step writer lane \
                        stage";
        assert_eq!(names.join(" "), expected);
    }

    #[test]
    fn flags_mark_the_last_step() {
        let mut out = Vec::new();
        write_flag(3, true, &mut out).unwrap();
        write_flag(2, false, &mut out).unwrap();
        assert_eq!(out, [0, 0, 1, 0, 0]);
    }

    /// The bytes of an array after its header.
    fn array(path: &Path, name: &str) -> Vec<u8> {
        let mut zip = zip::ZipArchive::new(File::open(path).unwrap()).unwrap();
        let mut bytes = Vec::new();
        zip.by_name(&format!("{name}.npy")).unwrap().read_to_end(&mut bytes).unwrap();
        let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        bytes.split_off(header)
    }

    #[test]
    fn the_rows_of_an_episode_stand_together() {
        let (folder, spec) = (tempfile::tempdir().unwrap(), fixtures::spec(4));
        let path = folder.path().join("x.npz");
        let part = |lane, first_step, steps, ending| {
            Ok(Part { writer: 9, sequence: 1, lane, episode: 0, first_step, steps, ending }.build(&spec))
        };
        let segments =
            [part(0, 0, 2, Ending::None), part(1, 5, 1, Ending::Truncated), part(0, 2, 1, Ending::Terminal)];
        export_npz(&path, &spec, segments.into_iter(), |_| ()).unwrap();
        let integers = |name: &str| -> Vec<i64> {
            let bytes = array(&path, name);
            bytes.as_chunks().0.iter().map(|&value| i64::from_le_bytes(value)).collect()
        };
        assert_eq!(integers("episode"), [0, 1, 1, 1]);
        assert_eq!(integers("step"), [5, 0, 1, 2]);
        assert_eq!(integers("writer"), [9; 4]);
        assert_eq!(array(&path, "terminal"), [0, 0, 0, 1]);
        assert_eq!(array(&path, "truncated"), [1, 0, 0, 0]);
        let observations: Vec<f32> = columns::iter(&array(&path, "observation")).collect();
        let next: Vec<f32> = columns::iter(&array(&path, "next_observation")).collect();
        assert_eq!(observations[3 * 3], fixtures::value(9, 0, 0, 2, 0, 0));
        assert_eq!(next[3 * 2..3 * 3], observations[3 * 3..]);
        assert_eq!(next[3 * 3 + 2], fixtures::value(9, 0, 0, 3, 0, 2));
        let beta: Vec<f32> = columns::iter(&array(&path, "beta")).collect();
        assert_eq!(beta[1..], [fixtures::value(9, 0, 0, 0, 3, 0); 3]);
    }

    #[test]
    fn a_column_with_the_name_of_an_own_array_is_refused() {
        let (folder, mut spec) = (tempfile::tempdir().unwrap(), fixtures::spec(4));
        spec.columns[1].name = "stage".to_owned();
        let refused = export_npz(&folder.path().join("x.npz"), &spec, std::iter::empty(), |_| ());
        assert!(matches!(refused, Err(ExportError::Reserved { column, .. }) if column == "stage"));
    }
}
