//! Bytes that mean nothing: every message and every stored file is parsed without a panic.
//!
//! Half of the inputs are valid ones with some bytes changed, cut out or repeated; the others are noise. A thousand
//! inputs each by default, half a million each with `GETUP_TEST_FULL`.

use crate::common;
use crate::fixtures::{self, Ending, Part, get_up_spec, spec};
use bytes::{Buf, BufMut, Bytes};
use getup_proto::{RunSpec, Segment, v1};
use getup_replay::{SampleOptions, Survey};
use prost::Message;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::HashMap;
use std::fs;
use std::time::Duration;
use tempfile::TempDir;
use tonic::Status;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::codegen::http::uri::PathAndQuery;

fn inputs() -> u64 {
    if std::env::var_os("GETUP_TEST_FULL").is_some() { 500_000 } else { 1_000 }
}

/// Something like `valid`, or nothing like it.
fn mangled(rng: &mut ChaCha8Rng, valid: &[u8]) -> Vec<u8> {
    if rng.random_bool(0.1) {
        let length = rng.random_range(0..400);
        return (0..length).map(|_| rng.random()).collect();
    }
    let mut bytes = valid.to_vec();
    for _ in 0..rng.random_range(1..6) {
        if bytes.is_empty() {
            break;
        }
        let place = rng.random_range(0..bytes.len());
        // Most of a message is values; its fields lie at the front.
        let place = if rng.random_bool(0.6) { place.min(rng.random_range(0..64)) } else { place };
        match rng.random_range(0..5) {
            0 => bytes[place] = rng.random(),
            1 => bytes[place] = [0, 0x7f, 0x80, 0xff][rng.random_range(0..4)],
            2 => bytes.truncate(place),
            3 => {
                let end = (place + rng.random_range(1..40)).min(bytes.len());
                bytes.drain(place..end);
            }
            _ => {
                let end = (place + rng.random_range(1..40)).min(bytes.len());
                let piece = bytes[place..end].to_vec();
                bytes.splice(place..place, piece);
            }
        }
    }
    bytes
}

#[test]
fn segments_are_parsed_or_refused() {
    let spec = spec(8);
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let part = Part {
        writer: 1,
        sequence: 1,
        lane: 2,
        episode: 3,
        first_step: 4,
        steps: 8,
        ending: Ending::Terminal,
    };
    let valid = part.build(&spec).to_wire().encode_to_vec();
    let (mut decoded, mut parsed) = (0, 0);
    for _ in 0..inputs() {
        let bytes = Bytes::from(mangled(&mut rng, &valid));
        let Ok(wire) = v1::Segment::decode(bytes) else { continue };
        decoded += 1;
        if let Ok(segment) = Segment::parse(wire, &spec) {
            parsed += 1;
            // What is accepted follows the spec whatever it was made of.
            assert!(segment.check(&spec).is_ok());
            assert_eq!(Segment::parse(segment.to_wire(), &spec).unwrap(), segment);
        }
    }
    assert!(
        decoded > inputs() / 20 && parsed > 0,
        "{decoded} decoded, {parsed} parsed: the inputs reach nothing"
    );
}

#[test]
fn requests_are_parsed_or_refused() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let spec = get_up_spec();
    let replay = common::Replay::start(spec.clone(), &common::config());
    let hello = v1::SampleHello {
        spec: Some(spec.to_wire()),
        batch: 256,
        n_step: 5,
        gamma: 0.9,
        seed: 1,
        name: "learner".to_owned(),
        table: String::new(),
        segments: false,
    };
    let sample =
        v1::SampleRequest { message: Some(v1::sample_request::Message::Hello(hello)) }.encode_to_vec();
    let append =
        v1::AppendRequest { message: Some(common::hello(&spec, 1)), ..Default::default() }.encode_to_vec();
    let mut specs = 0;
    let mut check_spec = |wire: Option<v1::RunSpec>| {
        if let Some(Ok(parsed)) = wire.map(RunSpec::parse) {
            specs += 1;
            assert!(parsed.validate().is_ok());
        }
    };
    for _ in 0..inputs() {
        if let Ok(v1::SampleRequest { message: Some(v1::sample_request::Message::Hello(hello)) }) =
            v1::SampleRequest::decode(Bytes::from(mangled(&mut rng, &sample)))
        {
            let (batch, n_step) = (hello.batch as usize, hello.n_step as usize);
            let (gamma, seed, segments) = (hello.gamma, hello.seed, hello.segments);
            let options = SampleOptions { batch, n_step, gamma, seed, segments };
            // What is accepted fits into a message.
            if replay.store.check_options(&options).is_ok() {
                let rows = if segments { 65 } else { 2 };
                assert!(batch * (rows * 68 + 24) * 4 <= getup_proto::MAX_MESSAGE_BYTES);
            }
            check_spec(hello.spec);
        }
        if let Ok(v1::AppendRequest { message: Some(v1::append_request::Message::Hello(hello)), .. }) =
            v1::AppendRequest::decode(Bytes::from(mangled(&mut rng, &append)))
        {
            check_spec(hello.spec);
        }
    }
    assert!(specs > inputs() / 50, "{specs} specs: the inputs reach nothing");
}

#[test]
fn stored_files_are_read_or_named_as_damaged() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let dir = TempDir::new().unwrap();
    let spec = spec(8);
    let store = common::open(dir.path(), &spec, &common::config()).unwrap();
    store.append((1..=6).map(|i| fixtures::segment(&spec, 1, i, 8)).collect()).unwrap();
    drop(store);
    let path = fs::read_dir(dir.path().join("segments")).unwrap().next().unwrap().unwrap().path();
    let valid = fs::read(&path).unwrap();
    let mut damaged = 0;
    // A survey opens sled too: slower than the parsers by far.
    let files = (inputs() / 10).min(5_000);
    for _ in 0..files {
        fs::write(&path, mangled(&mut rng, &valid)).unwrap();
        let mut segments = 0;
        let survey = Survey::read(dir.path(), |_| segments += 1).unwrap();
        assert_eq!(survey.segments, segments);
        assert!(segments <= 12);
        damaged += u64::from(!survey.damages.is_empty());
    }
    assert!(damaged > files / 4, "{damaged}: the inputs reach nothing");
}

/// Messages as they are: the client's side of a call sends any bytes, and takes any.
#[derive(Clone, Default)]
struct Raw;

impl Codec for Raw {
    type Encode = Vec<u8>;
    type Decode = Vec<u8>;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        Self
    }

    fn decoder(&mut self) -> Self {
        Self
    }
}

impl Encoder for Raw {
    type Item = Vec<u8>;
    type Error = Status;

    fn encode(&mut self, item: Vec<u8>, to: &mut EncodeBuf<'_>) -> Result<(), Status> {
        to.put_slice(&item);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = Vec<u8>;
    type Error = Status;

    fn decode(&mut self, from: &mut DecodeBuf<'_>) -> Result<Option<Vec<u8>>, Status> {
        let bytes = from.copy_to_bytes(from.remaining());
        Ok(Some(bytes.to_vec()))
    }
}

#[test]
fn a_running_service_refuses_every_mangled_request_and_goes_on() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let spec = spec(8);
    let folder = TempDir::new().unwrap();
    let dir = folder.path().join("store");
    let replay = common::Replay::start_in(&dir, spec.clone(), &common::config());
    let stored: Vec<Segment> = (1..=20).map(|sequence| fixtures::segment(&spec, 1, sequence, 8)).collect();
    replay.store.append(stored.clone()).unwrap();
    let hello = v1::SampleHello {
        spec: Some(spec.to_wire()),
        batch: 16,
        n_step: 1,
        gamma: 0.9,
        ..v1::SampleHello::default()
    };
    let sample = |message| v1::SampleRequest { message: Some(message) }.encode_to_vec();
    let append = |message| v1::AppendRequest { message: Some(message), ..Default::default() }.encode_to_vec();
    let priorities =
        v1::UpdatePrioritiesRequest { keys: vec![1, 2], priorities: vec![0.5; 2], ..Default::default() };
    // Each with the messages of a whole call.
    let calls = [
        (
            "Append",
            vec![
                append(common::hello(&spec, 2)),
                append(common::message(&fixtures::segment(&spec, 2, 1, 8))),
            ],
        ),
        (
            "Sample",
            vec![
                sample(v1::sample_request::Message::Hello(hello)),
                sample(v1::sample_request::Message::Credits(2)),
            ],
        ),
        ("Describe", vec![v1::DescribeRequest { table: "default".into() }.encode_to_vec()]),
        ("UpdatePriorities", vec![priorities.encode_to_vec()]),
        ("Snapshot", vec![v1::SnapshotRequest { name: "copy".into(), ..Default::default() }.encode_to_vec()]),
    ];
    let channel = replay.runtime.block_on(async {
        tonic::transport::Endpoint::from_shared(format!("http://{}", replay.endpoint))
            .unwrap()
            .connect()
            .await
            .unwrap()
    });
    let call = |method: &str, messages: Vec<Vec<u8>>| {
        let path = PathAndQuery::from_maybe_shared(format!("/getup.v1.Replay/{method}")).unwrap();
        let mut client = tonic::client::Grpc::new(channel.clone());
        replay.runtime.block_on(async {
            client.ready().await.unwrap();
            let request = tonic::Request::new(tokio_stream::iter(messages));
            let mut replies = client.streaming(request, path, Raw).await?.into_inner();
            // A stream that is right ends with its requests, or after what it was asked for.
            while let Ok(reply) = tokio::time::timeout(Duration::from_millis(200), replies.message()).await {
                if reply?.is_none() {
                    break;
                }
            }
            Ok::<(), Status>(())
        })
    };
    for (method, messages) in &calls {
        call(method, messages.clone()).unwrap_or_else(|status| panic!("{method} as it should be: {status}"));
    }
    let mut refused = HashMap::new();
    let rounds = (inputs() / 5).min(20_000);
    for _ in 0..rounds {
        let (method, messages) = &calls[rng.random_range(0..calls.len())];
        // One message of the call is mangled.
        let place = rng.random_range(0..messages.len());
        let mangle = |(index, message): (usize, &Vec<u8>)| {
            if index == place { mangled(&mut rng, message) } else { message.clone() }
        };
        let messages: Vec<Vec<u8>> = messages.iter().enumerate().map(mangle).collect();
        *refused.entry(*method).or_insert(0) += u64::from(call(method, messages).is_err());
    }
    // It is there, and what it held is whole.
    replay.runtime.block_on(getup_replay::describe(&replay.endpoint)).unwrap();
    for (method, _) in &calls {
        assert!(refused[method] > 0, "{method}: the inputs reach nothing, {refused:?}");
    }
    let (ended, _) = replay.stop();
    ended.unwrap();
    let mut held = Vec::new();
    let survey = Survey::read(&dir, |segment| held.push(segment)).unwrap();
    assert_eq!(survey.damages, Vec::<String>::new());
    assert!(held.iter().filter(|segment| segment.writer == 1).eq(&stored));
}
