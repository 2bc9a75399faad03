use super::*;
use crate::{ColumnSpec, Rows};
use proptest::prelude::*;
use prost::Message;

fn spec() -> RunSpec {
    let column = |name: &str, width, rows| ColumnSpec { name: name.to_owned(), width, rows };
    RunSpec {
        run: "first".to_owned(),
        task: "get_up/standard".to_owned(),
        columns: vec![
            column(columns::OBSERVATION, 3, Rows::StepsPlusOne),
            column(columns::ACTION, 2, Rows::Steps),
            column(columns::REWARD, 1, Rows::Steps),
            column(columns::BETA, 1, Rows::Once),
        ],
        max_segment_steps: 8,
    }
}

fn segment(steps: usize, fill: f32) -> Segment {
    let columns = spec()
        .columns
        .iter()
        .map(|column| columns::encode(&vec![fill; column.rows.count(steps) * column.width]))
        .collect();
    Segment {
        writer: 7,
        sequence: 1,
        lane: 2,
        episode: 3,
        first_step: 64,
        steps,
        env_steps: 1,
        terminal: false,
        truncated: false,
        stage: 0,
        first_version: PolicyVersion { incarnation: 1, counter: 4 },
        last_version: PolicyVersion { incarnation: 1, counter: 5 },
        columns,
        end: None,
        trace: None,
    }
}

fn end() -> EpisodeEnd {
    EpisodeEnd {
        episode_return: 12.5,
        env_steps: 250,
        reason: "time_limit".to_owned(),
        tags: BTreeMap::from([("fall".to_owned(), "prone".to_owned())]),
    }
}

proptest! {
    #[test]
    fn every_segment_survives_the_wire(
        steps in 1usize..=8,
        fill in -1e30f32..1e30,
        writer: u64,
        sequence in 1u64..,
        ending in 0..3,
    ) {
        let mut segment = segment(steps, fill);
        segment.writer = writer;
        segment.sequence = sequence;
        segment.terminal = ending == 1;
        segment.truncated = ending == 2;
        segment.end = (ending != 0).then(end);
        let bytes = Bytes::from(segment.to_wire().encode_to_vec());
        let wire = v1::Segment::decode(bytes).expect("it was just encoded");
        prop_assert_eq!(Segment::parse(wire, &spec()), Ok(segment));
    }

    #[test]
    fn no_change_of_a_byte_of_a_column_passes_the_checksum(byte in 0usize..48, flip in 1u8..) {
        let mut wire = segment(3, 0.5).to_wire();
        let mut column = wire.columns[0].to_vec();
        column[byte] ^= flip;
        wire.columns[0] = column.into();
        let refused = matches!(Segment::parse(wire, &spec()), Err(SegmentError::Checksum { .. }));
        prop_assert!(refused);
    }

    #[test]
    fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        if let Ok(wire) = v1::Segment::decode(Bytes::from(bytes)) {
            let _ = Segment::parse(wire, &spec());
        }
    }
}

fn refused(change: impl FnOnce(&mut Segment)) -> SegmentError {
    let mut segment = segment(4, 0.5);
    change(&mut segment);
    Segment::parse(segment.to_wire(), &spec()).expect_err("the segment is malformed")
}

#[test]
fn a_malformed_segment_is_refused_with_its_reason() {
    assert_eq!(refused(|s| s.sequence = 0), SegmentError::Sequence);
    assert_eq!(refused(|s| s.steps = 9), SegmentError::Steps { steps: 9, limit: 8 });
    assert_eq!(refused(|s| s.steps = 0), SegmentError::Steps { steps: 0, limit: 8 });
    assert!(matches!(refused(|s| s.env_steps = 5), SegmentError::Counts { .. }));
    assert!(matches!(refused(|s| s.first_step = u32::MAX), SegmentError::Counts { .. }));
    assert!(matches!(refused(|s| s.terminal = true), SegmentError::End { .. }));
    assert!(matches!(refused(|s| s.end = Some(end())), SegmentError::End { .. }));
    assert_eq!(
        refused(|s| {
            s.columns.pop();
        }),
        SegmentError::Columns { columns: 3, expected: 4 }
    );
    assert_eq!(
        refused(|s| s.columns[1] = columns::encode(&[0.0; 7])),
        SegmentError::Dimensions { column: "action".into(), steps: 4, bytes: 28, expected: 32 }
    );
    let infinite = [0.0, 0.0, 0.0, f32::INFINITY, 0.0, 0.0, 0.0, 0.0];
    assert_eq!(
        refused(|s| s.columns[1] = columns::encode(&infinite)),
        SegmentError::NonFinite { column: "action".into(), row: 1, place: 1, value: f32::INFINITY }
    );
    assert_eq!(
        refused(|s| {
            s.terminal = true;
            s.end = Some(EpisodeEnd { episode_return: f32::NEG_INFINITY, ..end() });
        }),
        SegmentError::Return(f32::NEG_INFINITY)
    );
}

#[test]
fn a_segment_put_together_by_hand_is_checked_like_a_parsed_one() {
    assert_eq!(segment(4, 0.5).check(&spec()), Ok(()));
    let mut wrong = segment(4, 0.5);
    wrong.columns[2] = columns::encode(&[f32::NAN; 4]);
    assert_eq!(wrong.check(&spec()).unwrap_err().kind(), "non_finite");
    wrong.steps = 3;
    assert_eq!(wrong.check(&spec()).unwrap_err().kind(), "dimensions");
}

#[test]
fn a_segment_without_a_policy_version_is_refused() {
    let mut wire = segment(4, 0.5).to_wire();
    wire.last_version = None;
    assert_eq!(Segment::parse(wire, &spec()), Err(SegmentError::Version));
}

#[test]
fn a_trace_is_no_part_of_what_is_sent_as_a_segment_and_stored() {
    let plain = segment(3, 0.5);
    let context = crate::TraceContext { trace_id: 1, span_id: 2 };
    let traced = Segment { trace: Some(Box::new(crate::SegmentTrace::arrived(context))), ..plain.clone() };
    assert_eq!(traced.to_wire(), plain.to_wire());
    assert_eq!(Segment::parse(traced.to_wire(), &spec()), Ok(plain));
}
