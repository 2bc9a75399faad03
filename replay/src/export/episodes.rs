//! From interleaved segments to episodes: [`each_episode`].

use super::{ExportError, Exported};
use crate::error::StoreError;
use getup_proto::{ColumnSpec, Rows, RunSpec, Segment, columns};
use std::collections::HashMap;
use std::io::{self, Write};

/// Steps an episode. With the row after the last one this is what pyarrow's scanner hands out in one batch, and
/// Minari takes a batch for an episode.
const MAX_STEPS: usize = (1 << 17) - 1;

/// Consecutive steps of an episode, as segments without a gap.
#[derive(Debug)]
pub(super) struct Episode {
    /// At least one.
    segments: Vec<Segment>,
    steps: usize,
}

impl Episode {
    fn new(segment: Segment) -> Self {
        Self { steps: segment.steps, segments: vec![segment] }
    }

    fn push(&mut self, segment: Segment) {
        self.steps += segment.steps;
        self.segments.push(segment);
    }

    fn is_continued_by(&self, segment: &Segment) -> bool {
        let next_step = self.first().first_step as usize + self.steps;
        self.first().episode == segment.episode
            && next_step == segment.first_step as usize
            && self.steps + segment.steps <= MAX_STEPS
    }

    /// In order, at least one.
    pub(super) fn segments(&self) -> &[Segment] {
        &self.segments
    }

    pub(super) fn first(&self) -> &Segment {
        self.segments.first().expect("an episode begins with a segment")
    }

    pub(super) fn last(&self) -> &Segment {
        self.segments.last().expect("an episode begins with a segment")
    }

    /// From 1.
    pub(super) fn steps(&self) -> usize {
        self.steps
    }

    /// Whether the last step ends it.
    pub(super) fn is_finished(&self) -> bool {
        ends(self.last())
    }

    /// Writes the row of each step of the column `index` of the spec: for a state, the one before the step.
    pub(super) fn write_rows(
        &self,
        index: usize,
        column: &ColumnSpec,
        out: &mut impl Write,
    ) -> io::Result<()> {
        for segment in &self.segments {
            let values = &segment.columns[index];
            match column.rows {
                Rows::Once => (0..segment.steps).try_for_each(|_| out.write_all(values))?,
                Rows::Steps | Rows::StepsPlusOne => {
                    out.write_all(&values[..segment.steps * row_bytes(column)])?
                }
            }
        }
        Ok(())
    }

    /// Writes, of a column with one row more than steps, the row after each step.
    pub(super) fn write_next_rows(
        &self,
        index: usize,
        column: &ColumnSpec,
        out: &mut impl Write,
    ) -> io::Result<()> {
        self.segments
            .iter()
            .try_for_each(|segment| out.write_all(&segment.columns[index][row_bytes(column)..]))
    }

    /// Writes the row that goes with the state after the last step: zeros where a column has a row a step.
    pub(super) fn write_final_row(
        &self,
        index: usize,
        column: &ColumnSpec,
        out: &mut impl Write,
    ) -> io::Result<()> {
        let segment = self.last();
        match column.rows {
            Rows::Once => out.write_all(&segment.columns[index]),
            Rows::Steps => out.write_all(&vec![0; row_bytes(column)]),
            Rows::StepsPlusOne => out.write_all(&segment.columns[index][segment.steps * row_bytes(column)..]),
        }
    }
}

fn row_bytes(column: &ColumnSpec) -> usize {
    column.width * columns::VALUE_BYTES
}

fn ends(segment: &Segment) -> bool {
    segment.terminal || segment.truncated
}

/// Puts episodes together and passes them to `write`, in the order of the export: each when the log has come to
/// its end, or to something else of its lane, and the rest at last. `progress` is told how many transitions were
/// written so far.
///
/// # Errors
/// What `segments` or `write` give, and [`StoreError::Segment`] if a segment does not follow `spec`.
pub(super) fn each_episode(
    spec: &RunSpec,
    segments: impl Iterator<Item = Result<Segment, StoreError>>,
    mut write: impl FnMut(&Episode) -> Result<(), ExportError>,
    mut progress: impl FnMut(u64),
) -> Result<Exported, ExportError> {
    let mut exported = Exported::default();
    let mut export = |episode: &Episode| {
        write(episode)?;
        exported.transitions += episode.steps() as u64;
        exported.episodes += 1;
        exported.unfinished += u64::from(!episode.is_finished());
        progress(exported.transitions);
        Ok::<_, ExportError>(())
    };
    // Of each lane, the episode that may go on, and the place in the log where it began.
    let mut open: HashMap<(u64, u32), (usize, Episode)> = HashMap::new();
    for (number, segment) in segments.enumerate() {
        let segment = segment?;
        segment.check(spec).map_err(StoreError::from)?;
        let lane = (segment.writer, segment.lane);
        let over = ends(&segment);
        let (began, episode) = match open.remove(&lane) {
            Some((began, mut episode)) if episode.is_continued_by(&segment) => {
                episode.push(segment);
                (began, episode)
            }
            other => {
                if let Some((_, left)) = other {
                    export(&left)?;
                }
                (number, Episode::new(segment))
            }
        };
        if over {
            export(&episode)?;
        } else {
            open.insert(lane, (began, episode));
        }
    }
    let mut rest: Vec<_> = open.into_values().collect();
    rest.sort_by_key(|(began, _)| *began);
    rest.iter().try_for_each(|(_, episode)| export(episode))?;
    Ok(exported)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{self, Ending, Part};

    /// Writer, lane, episode, first step, steps, ending.
    type Row = (u64, u32, u64, u32, usize, Ending);

    fn segment(spec: &RunSpec, (writer, lane, episode, first_step, steps, ending): Row) -> Segment {
        Part { writer, sequence: 1, lane, episode, first_step, steps, ending }.build(spec)
    }

    /// What comes of the segments: lane, episode, first step, steps, and whether it is finished.
    fn episodes(spec: &RunSpec, rows: &[Row]) -> Vec<(u32, u64, u32, usize, bool)> {
        let mut found = Vec::new();
        let mut done = Vec::new();
        let note = |episode: &Episode| {
            let Segment { lane, episode: number, first_step, .. } = *episode.first();
            found.push((lane, number, first_step, episode.steps(), episode.is_finished()));
            Ok(())
        };
        let segments = rows.iter().map(|&row| Ok(segment(spec, row)));
        let exported = each_episode(spec, segments, note, |transitions| done.push(transitions)).unwrap();
        assert_eq!(exported.episodes as usize, found.len());
        assert_eq!(exported.unfinished as usize, found.iter().filter(|episode| !episode.4).count());
        let total = rows.iter().map(|row| row.4 as u64).sum::<u64>();
        assert_eq!(exported.transitions, total, "every step is exported");
        assert_eq!(done.last(), Some(&total));
        found
    }

    #[test]
    fn interleaved_segments_become_episodes_in_the_order_in_which_they_end() {
        use Ending::{None, Terminal, Truncated};
        let rows = [
            (1, 0, 7, 4, 4, None), // its beginning is missing
            (1, 1, 3, 0, 4, None),
            (2, 1, 3, 0, 2, Terminal), // another writer's
            (1, 1, 3, 4, 3, Truncated),
            (1, 0, 7, 8, 1, None),
            (1, 1, 4, 0, 4, None), // never ends
            (1, 0, 7, 9, 4, Terminal),
        ];
        let expected = [(1, 3, 0, 2, true), (1, 3, 0, 7, true), (0, 7, 4, 9, true), (1, 4, 0, 4, false)];
        assert_eq!(episodes(&fixtures::spec(8), &rows), expected);
    }

    #[test]
    fn an_episode_that_was_given_up_comes_when_its_lane_begins_another() {
        use Ending::{None, Terminal};
        let rows =
            [(1, 5, 0, 0, 4, None), (1, 0, 0, 0, 2, None), (1, 0, 1, 0, 2, Terminal), (1, 5, 0, 4, 4, None)];
        let expected = [(0, 0, 0, 2, false), (0, 1, 0, 2, true), (5, 0, 0, 8, false)];
        assert_eq!(episodes(&fixtures::spec(8), &rows), expected);
    }

    #[test]
    fn a_gap_begins_an_episode_anew() {
        use Ending::{None, Terminal};
        let rows = [(1, 0, 0, 0, 4, None), (1, 0, 0, 8, 4, Terminal)];
        assert_eq!(episodes(&fixtures::spec(8), &rows), [(0, 0, 0, 4, false), (0, 0, 8, 4, true)]);
    }

    #[test]
    fn an_episode_too_long_for_one_batch_is_divided() {
        let long = 1 << 16;
        let rows = [(1, 0, 0, 0, long, Ending::None), (1, 0, 0, long as u32, long, Ending::Terminal)];
        let expected = [(0, 0, 0, long, false), (0, 0, long as u32, long, true)];
        assert_eq!(episodes(&fixtures::spec(long), &rows), expected);
    }

    #[test]
    fn rows_are_joined_across_segments() {
        let spec = fixtures::spec(4);
        let mut episode = Episode::new(segment(&spec, (1, 0, 0, 2, 3, Ending::None)));
        episode.push(segment(&spec, (1, 0, 0, 5, 2, Ending::Terminal)));
        let expected = |index: usize, steps: std::ops::Range<usize>| {
            let width = spec.columns[index].width;
            let values = steps.flat_map(|step| (0..width).map(move |place| (step, place)));
            let values: Vec<f32> =
                values.map(|(step, place)| fixtures::value(1, 0, 0, step, index, place)).collect();
            columns::encode(&values).to_vec()
        };
        let mut out = Vec::new();
        episode.write_rows(0, &spec.columns[0], &mut out).unwrap();
        assert_eq!(out, expected(0, 2..7));
        episode.write_final_row(0, &spec.columns[0], &mut out).unwrap();
        assert_eq!(out, expected(0, 2..8));
        let mut out = Vec::new();
        episode.write_next_rows(0, &spec.columns[0], &mut out).unwrap();
        assert_eq!(out, expected(0, 3..8));
        let mut out = Vec::new();
        episode.write_rows(1, &spec.columns[1], &mut out).unwrap();
        episode.write_final_row(1, &spec.columns[1], &mut out).unwrap();
        assert_eq!(out, [expected(1, 2..7), vec![0; 8]].concat());
        let mut out = Vec::new();
        episode.write_rows(3, &spec.columns[3], &mut out).unwrap();
        episode.write_final_row(3, &spec.columns[3], &mut out).unwrap();
        assert_eq!(out, expected(3, 0..1).repeat(6));
    }
}
