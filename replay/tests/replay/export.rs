//! What is exported reads back as it was written: by NumPy and by Minari, where a Python has them.

use crate::common::skip;
use crate::fixtures::{self, Ending, Part};
use getup_proto::{ColumnSpec, Rows, RunSpec, Segment, columns};
use getup_replay::{DatasetId, export_minari, export_npz};
use serde_json::{Value, json};
use std::path::Path;
use std::process::Command;

/// Says that a Python lacks the packages.
const SKIPPED: i32 = 77;

/// A spec with columns besides those of the task, in another order.
fn spec() -> RunSpec {
    let mut spec = fixtures::spec(16);
    let column = |name: &str, width, rows| ColumnSpec { name: name.to_owned(), width, rows };
    spec.columns.insert(0, column("torque", 5, Rows::Steps));
    spec.columns.push(column("height", 2, Rows::StepsPlusOne));
    spec.columns.push(column("seed", 3, Rows::Once));
    spec
}

/// Lanes of three writers, interleaved: evicted beginnings, episodes that were given up, a gap, open ends.
fn segments(spec: &RunSpec) -> Vec<Segment> {
    let mut segments = Vec::new();
    let mut sequence = [0; 3];
    // Of each lane: episode, next step.
    let mut lanes: Vec<(u64, u32)> = (0..12).map(|lane| (lane % 3, [0, 40, 0][lane as usize % 3])).collect();
    for turn in 0..400_usize {
        let index = (turn * 7 + turn / 5) % lanes.len();
        let (writer, lane) = (index % 3, (index / 3) as u32);
        let (episode, first_step) = lanes[index];
        let steps = 1 + (turn * 13 + index) % 16;
        let ending = match turn % 11 {
            3 => Ending::Terminal,
            6 => Ending::Truncated,
            _ => Ending::None,
        };
        sequence[writer] += 1;
        let id = [u64::MAX, 1, 1 << 63][writer];
        let part = Part { writer: id, sequence: sequence[writer], lane, episode, first_step, steps, ending };
        let mut segment = part.build(spec);
        segment.stage = episode as u32 / 2;
        segments.push(segment);
        let next = first_step + steps as u32;
        lanes[index] = match (ending, turn % 17) {
            (Ending::None, 4) => (episode + 1, 0),    // given up
            (Ending::None, 9) => (episode, next + 5), // a gap
            (Ending::None, _) => (episode, next),
            _ => (episode + 1, turn as u32 % 3),
        };
    }
    segments
}

/// The facts that the check reads: every transition is a sample. Episodes are put together here in another way
/// than the export's: from the back.
fn facts(spec: &RunSpec, segments: &[Segment]) -> Value {
    // Of each part: segments, and the place in the log where it is complete.
    let mut parts: Vec<(Vec<&Segment>, (usize, usize))> = Vec::new();
    for (at, segment) in segments.iter().enumerate() {
        let lane = |other: &Segment| (other.writer, other.lane) == (segment.writer, segment.lane);
        let previous = segments[..at].iter().rposition(lane);
        let ended = |s: &Segment| s.terminal || s.truncated;
        let joined = previous.map(|p| &segments[p]).is_some_and(|p| {
            !ended(p)
                && p.episode == segment.episode
                && p.first_step as usize + p.steps == segment.first_step as usize
        });
        let next = segments[at + 1..].iter().position(lane).map(|next| at + 1 + next);
        let part = match joined {
            true => parts
                .iter()
                .position(|(part, _)| std::ptr::eq(part[part.len() - 1], &segments[previous.unwrap()])),
            false => None,
        };
        let index = part.unwrap_or_else(|| {
            parts.push((Vec::new(), (0, at)));
            parts.len() - 1
        });
        parts[index].0.push(segment);
        parts[index].1.0 = if ended(segment) { at * 2 + 1 } else { next.map_or(usize::MAX, |next| next * 2) };
    }
    parts.sort_by_key(|part| part.1);
    let mut samples = Vec::new();
    for (episode, (part, _)) in parts.iter().enumerate() {
        let mut at = 0;
        for (index, segment) in part.iter().enumerate() {
            for step in 0..segment.steps {
                let last = step + 1 == segment.steps;
                let end = last && index + 1 == part.len();
                let row = |c: usize, row: usize| -> Vec<f32> {
                    columns::iter(&segment.columns[c])
                        .skip(row * spec.columns[c].width)
                        .take(spec.columns[c].width)
                        .collect()
                };
                let all = || spec.columns.iter().enumerate();
                let values: Value = all()
                    .map(|(c, column)| {
                        (column.name.clone(), json!(row(c, if column.rows == Rows::Once { 0 } else { step })))
                    })
                    .collect::<serde_json::Map<_, _>>()
                    .into();
                let next: Value = all()
                    .filter(|(_, column)| column.rows == Rows::StepsPlusOne)
                    .map(|(c, column)| (column.name.clone(), json!(row(c, step + 1))))
                    .collect::<serde_json::Map<_, _>>()
                    .into();
                samples.push(json!({
                    "episode": episode, "at": at, "step": segment.first_step as usize + step,
                    "writer": segment.writer, "lane": segment.lane, "stage": segment.stage,
                    "terminal": last && segment.terminal, "truncated": last && segment.truncated,
                    "cut": end && segment.end.is_none(), "values": values, "next": next,
                }));
                at += 1;
            }
        }
    }
    let columns: serde_json::Map<_, _> = (spec.columns.iter())
        .map(|column| (column.name.clone(), json!({"width": column.width, "rows": column.rows})))
        .collect();
    json!({"transitions": samples.len(), "episodes": parts.len(), "columns": columns, "samples": samples})
}

fn check(format: &str, path: &Path, facts: &Path) {
    let python = std::env::var("GETUP_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/replay/export_check.py");
    let output = match Command::new(&python).arg(script).arg(format).arg(path).arg(facts).output() {
        Ok(output) => output,
        Err(error) => return skip(format!("{format}: {python} does not start: {error}")),
    };
    let said = String::from_utf8_lossy(&output.stdout);
    match output.status.code() {
        Some(0) => eprintln!("{said}"),
        Some(SKIPPED) => skip(format!("{format}: {python}: {said}")),
        _ => panic!("{said}{}", String::from_utf8_lossy(&output.stderr)),
    }
}

#[test]
fn numpy_and_minari_read_what_was_stored() {
    let kept = tempfile::tempdir().unwrap();
    let folder = kept.path();
    let (spec, facts_path) = (spec(), folder.join("facts.json"));
    let segments = segments(&spec);
    let facts = facts(&spec, &segments);
    std::fs::write(&facts_path, facts.to_string()).unwrap();
    let all = || segments.iter().cloned().map(Ok);

    let npz = folder.join("replay.npz");
    let exported = export_npz(&npz, &spec, all(), |_| ()).unwrap();
    assert_eq!(
        (json!(exported.transitions), json!(exported.episodes)),
        (facts["transitions"].clone(), facts["episodes"].clone())
    );
    check("npz", &npz, &facts_path);

    let minari = folder.join("getup/replay-v0");
    let id = DatasetId::of_folder(&minari, Some(folder)).unwrap();
    assert_eq!(export_minari(&minari, &id, &spec, all(), |_| ()).unwrap(), exported);
    check("minari", &minari, &facts_path);
}
