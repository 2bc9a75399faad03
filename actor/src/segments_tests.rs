//! Tests of the segment builder.

use getup_proto::ColumnSpec;
use proptest::prelude::*;

use super::*;

fn spec(max_segment_steps: usize) -> RunSpec {
    let column = |name: &str, width, rows| ColumnSpec { name: name.to_owned(), width, rows };
    RunSpec {
        run: "run".to_owned(),
        task: "getup/standard".to_owned(),
        columns: vec![
            column(OBSERVATION, 3, Rows::StepsPlusOne),
            column(ACTION, 2, Rows::Steps),
            column(REWARD, 1, Rows::Steps),
            column(BETA, 1, Rows::Once),
        ],
        max_segment_steps,
    }
}

/// Numbers that name their step, so that a misplaced row shows.
fn observation(step: usize) -> [f32; 3] {
    [step as f32, step as f32 + 0.25, step as f32 + 0.5]
}

fn play(
    builder: &mut SegmentBuilder,
    limp: usize,
    control: usize,
    store_limp: bool,
    end: StepEnd,
) -> Vec<Segment> {
    let steps = limp + control;
    let segments = (0..steps).filter_map(|step| {
        if step < limp && !store_limp {
            builder.skip();
            return None;
        }
        builder.push(&StepRecord {
            observation: &observation(step),
            action: &[step as f32, -(step as f32)],
            reward: 0.5,
            next_observation: &observation(step + 1),
            env_step: step >= limp,
            version: PolicyVersion { incarnation: 1, counter: step as u64 },
            end: match step + 1 {
                last if last == steps => end,
                last if last == limp => StepEnd::Landed,
                _ => StepEnd::Continues,
            },
        })
    });
    segments.collect()
}

fn values(segment: &Segment, column: usize) -> Vec<f32> {
    columns::iter(&segment.columns[column]).collect()
}

proptest! {
    #[test]
    fn joined_segments_are_the_episode_and_count_its_env_steps(
        segment_steps in 1usize..70,
        limp in 0usize..100,
        control in 1usize..200,
        store_limp: bool,
        terminal: bool,
    ) {
        let spec = spec(70);
        let end = if terminal { StepEnd::Terminal } else { StepEnd::TimeLimit };
        let mut builder = SegmentBuilder::new(&spec, 3, 2, segment_steps, 9, 4).unwrap();
        builder.begin(5, 2, 0.75);
        let segments = play(&mut builder, limp, control, store_limp, end);

        let mut step = if store_limp { 0 } else { limp };
        for (index, segment) in segments.iter().enumerate() {
            let last = index + 1 == segments.len();
            prop_assert_eq!((segment.writer, segment.lane, segment.episode, segment.stage), (9, 4, 5, 2));
            prop_assert_eq!(segment.first_step as usize, step);
            prop_assert!(segment.steps >= 1 && segment.steps <= segment_steps);
            let rows = step..=step + segment.steps;
            prop_assert_eq!(values(segment, 0), rows.flat_map(observation).collect::<Vec<_>>());
            let actions = step..step + segment.steps;
            prop_assert_eq!(
                values(segment, 1), actions.flat_map(|step| [step as f32, -(step as f32)]).collect::<Vec<_>>()
            );
            prop_assert_eq!(values(segment, 2).len(), segment.steps);
            prop_assert_eq!(values(segment, 3), [0.75]);
            prop_assert_eq!(segment.first_version.counter as usize, step);
            prop_assert_eq!(segment.env_steps as usize, if step < limp { 0 } else { segment.steps });
            step += segment.steps;
            prop_assert_eq!(segment.last_version.counter as usize, step - 1);
            prop_assert_eq!((segment.terminal, segment.truncated), (last && terminal, last && !terminal));
            prop_assert_eq!(segment.end.is_some(), last);

            let numbered = Segment { sequence: index as u64 + 1, ..segment.clone() };
            prop_assert_eq!(Segment::parse(numbered.to_wire(), &spec), Ok(numbered));
        }
        prop_assert_eq!(step, limp + control);
        prop_assert_eq!(segments.iter().map(|segment| segment.env_steps as usize).sum::<usize>(), control);
        let end = segments.last().unwrap().end.as_ref().unwrap();
        prop_assert_eq!(end.env_steps as usize, control);
        prop_assert_eq!(end.episode_return, control as f32 * 0.5);
    }
}

#[test]
fn an_abandoned_episode_leaves_nothing_in_the_next() {
    let mut builder = SegmentBuilder::new(&spec(64), 3, 2, 64, 1, 0).unwrap();
    builder.begin(0, 0, 1.0);
    play(&mut builder, 0, 10, true, StepEnd::Continues);
    builder.begin(1, 0, 0.5);
    let segments = play(&mut builder, 0, 3, true, StepEnd::TimeLimit);
    assert_eq!((segments.len(), segments[0].steps, segments[0].first_step), (1, 3, 0));
    assert_eq!(segments[0].end.as_ref().unwrap().episode_return, 1.5);
}

#[test]
fn a_spec_that_the_task_cannot_fill_is_refused_with_its_reason() {
    let refused = |spec: &RunSpec| SegmentBuilder::new(spec, 3, 2, 64, 1, 0).unwrap_err();
    let mut unknown = spec(64);
    unknown.columns[1].name = "torque".into();
    assert_eq!(refused(&unknown), LayoutError::Unknown("torque".into()));
    let mut wide = spec(64);
    wide.columns[0].width = 68;
    assert!(refused(&wide).to_string().contains("observation of the run's spec has width 68"));
    assert_eq!(refused(&spec(32)), LayoutError::SegmentSteps { steps: 64, limit: 32 });
}
