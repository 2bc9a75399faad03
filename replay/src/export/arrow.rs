//! Arrow's file format, as far as it is needed: one record batch of floats and booleans, none of them missing.
//!
//! A file is the schema, the batch, and a footer that says where the batch is (*Apache Arrow Columnar Format*,
//! "Serialization and Interprocess Communication"). Flatbuffers describe them, whose tables come from
//! `polars-arrow-format`; the framing around them is short, and spares every build the compute kernels that Arrow's
//! own writer brings along.

use polars_arrow_format::ipc::planus::{Builder, WriteAsOffset};
use polars_arrow_format::ipc::{
    Block, Bool, Buffer, Endianness, Field, FieldNode, FixedSizeList, FloatingPoint, Footer, Message,
    MessageHeader, MetadataVersion, Precision, RecordBatch, Schema, Struct, Type,
};
use std::io::{self, Write};

/// Begins and ends a file.
const MAGIC: &[u8] = b"ARROW1";
/// The magic at the beginning is padded to it, and so is a message.
const MESSAGE_ALIGNMENT: usize = 8;
/// Buffers begin at multiples of it in the batch's body: what Arrow recommends.
const BUFFER_ALIGNMENT: usize = 64;
/// Begins a message.
const CONTINUATION: [u8; 4] = [0xff; 4];
const VERSION: MetadataVersion = MetadataVersion::V5;

/// What a field holds in each row.
pub(super) enum Kind {
    /// An `f32`.
    Float,
    /// A boolean.
    Bool,
    /// So many `f32`s.
    Floats(usize),
    /// One of each of these fields.
    Group(Vec<Field>),
}

/// A field of a batch.
pub(super) fn field(name: &str, kind: Kind) -> Field {
    let float = || Type::FloatingPoint(Box::new(FloatingPoint { precision: Precision::Single }));
    let (type_, children) = match kind {
        Kind::Float => (float(), Vec::new()),
        Kind::Bool => (Type::Bool(Box::new(Bool {})), Vec::new()),
        Kind::Floats(width) => {
            let list_size = i32::try_from(width).expect("a spec's widths are below 2^20");
            let item = Field { type_: Some(float()), ..named("item") };
            (Type::FixedSizeList(Box::new(FixedSizeList { list_size })), vec![item])
        }
        Kind::Group(fields) => (Type::Struct(Box::new(Struct {})), fields),
    };
    Field { type_: Some(type_), children: Some(children), ..named(name) }
}

fn named(name: &str) -> Field {
    Field { name: Some(name.to_owned()), nullable: true, children: Some(Vec::new()), ..Field::default() }
}

/// The values of a batch. Its fields are added in the schema's order, a group before what is in it.
pub(super) struct Batch {
    rows: usize,
    nodes: Vec<FieldNode>,
    buffers: Vec<Buffer>,
    body: Vec<u8>,
}

impl Batch {
    pub(super) fn new(rows: usize) -> Self {
        Self { rows, nodes: Vec::new(), buffers: Vec::new(), body: Vec::new() }
    }

    /// Adds a field of [`Kind::Float`], whose values `write` writes.
    pub(super) fn float(&mut self, write: impl FnOnce(&mut Vec<u8>) -> io::Result<()>) -> io::Result<()> {
        self.node(self.rows);
        self.buffer(write)
    }

    /// Adds a field of [`Kind::Floats`], whose values `write` writes.
    pub(super) fn floats(
        &mut self,
        width: usize,
        write: impl FnOnce(&mut Vec<u8>) -> io::Result<()>,
    ) -> io::Result<()> {
        self.node(self.rows);
        self.node(self.rows * width);
        self.buffer(write)
    }

    /// Adds a field of [`Kind::Bool`] that is false but in the row `set`.
    pub(super) fn flag(&mut self, set: Option<usize>) -> io::Result<()> {
        self.node(self.rows);
        let mut bits = vec![0; self.rows.div_ceil(8)];
        if let Some(row) = set {
            bits[row / 8] |= 1 << (row % 8);
        }
        self.buffer(|body| body.write_all(&bits))
    }

    /// Begins a field of [`Kind::Group`].
    pub(super) fn group(&mut self) {
        self.node(self.rows);
    }

    /// Notes so many values, and that none of them is missing.
    fn node(&mut self, values: usize) {
        self.nodes.push(FieldNode { length: values as i64, null_count: 0 });
        self.buffers.push(Buffer { offset: self.body.len() as i64, length: 0 });
    }

    fn buffer(&mut self, write: impl FnOnce(&mut Vec<u8>) -> io::Result<()>) -> io::Result<()> {
        let offset = self.body.len();
        write(&mut self.body)?;
        self.buffers.push(Buffer { offset: offset as i64, length: (self.body.len() - offset) as i64 });
        self.body.resize(self.body.len().next_multiple_of(BUFFER_ALIGNMENT), 0);
        Ok(())
    }
}

/// The bytes of a file with these fields and this one batch.
pub(super) fn file(fields: &[Field], batch: Batch) -> Vec<u8> {
    let Batch { rows, nodes, buffers, body } = batch;
    let schema =
        Schema { endianness: Endianness::Little, fields: Some(fields.to_vec()), ..Schema::default() };
    let body_length = body.len() as i64;
    let records = RecordBatch {
        length: rows as i64,
        nodes: Some(nodes),
        buffers: Some(buffers),
        ..RecordBatch::default()
    };

    let mut bytes = MAGIC.to_vec();
    bytes.resize(MESSAGE_ALIGNMENT, 0);
    push_message(&mut bytes, MessageHeader::Schema(Box::new(schema.clone())), 0);
    let offset = bytes.len();
    push_message(&mut bytes, MessageHeader::RecordBatch(Box::new(records)), body_length);
    let meta_data_length = (bytes.len() - offset) as i32;
    bytes.extend_from_slice(&body);
    // No more messages.
    bytes.extend_from_slice(&CONTINUATION);
    bytes.extend_from_slice(&0_i32.to_le_bytes());

    let block = Block { offset: offset as i64, meta_data_length, body_length };
    let footer = encode(&Footer {
        version: VERSION,
        schema: Some(Box::new(schema)),
        record_batches: Some(vec![block]),
        ..Footer::default()
    });
    bytes.extend_from_slice(&footer);
    bytes.extend_from_slice(&(footer.len() as i32).to_le_bytes());
    bytes.extend_from_slice(MAGIC);
    bytes
}

/// Adds a message: its length, which counts the padding, and its description. Its body follows.
fn push_message(bytes: &mut Vec<u8>, header: MessageHeader, body_length: i64) {
    let message = Message { version: VERSION, header: Some(header), body_length, custom_metadata: None };
    let mut message = encode(&message);
    message.resize(message.len().next_multiple_of(MESSAGE_ALIGNMENT), 0);
    bytes.extend_from_slice(&CONTINUATION);
    bytes.extend_from_slice(&(message.len() as i32).to_le_bytes());
    bytes.extend_from_slice(&message);
}

fn encode<T>(table: impl WriteAsOffset<T>) -> Vec<u8> {
    Builder::new().finish(table, None).to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use polars_arrow_format::ipc::planus::ReadAsRoot;
    use polars_arrow_format::ipc::{FooterRef, MessageHeaderRef, MessageRef};

    fn integer(bytes: &[u8]) -> usize {
        i32::from_le_bytes(bytes.try_into().unwrap()).try_into().unwrap()
    }

    #[test]
    fn the_footer_leads_to_every_buffer() {
        let fields = [
            field("state", Kind::Floats(3)),
            field("last", Kind::Bool),
            field("more", Kind::Group(vec![field("x", Kind::Float)])),
        ];
        let mut batch = Batch::new(9);
        batch.floats(3, |out| out.write_all(&[7; 4 * 3 * 9])).unwrap();
        batch.flag(Some(8)).unwrap();
        batch.group();
        batch.float(|out| out.write_all(&[5; 4 * 9])).unwrap();
        let bytes = file(&fields, batch);

        let (head, magic) = bytes.split_at(bytes.len() - MAGIC.len());
        assert_eq!((magic, &bytes[..8]), (MAGIC, &b"ARROW1\0\0"[..]));
        let (head, length) = head.split_at(head.len() - 4);
        let footer = FooterRef::read_as_root(&head[head.len() - integer(length)..]).unwrap();
        let schema: Schema = footer.schema().unwrap().unwrap().try_into().unwrap();
        assert_eq!(schema.fields.unwrap(), fields);
        let block = footer.record_batches().unwrap().unwrap().iter().next().unwrap();
        let message = &bytes[block.offset() as usize..];
        assert_eq!(message[..4], CONTINUATION);
        let body = &message[block.meta_data_length() as usize..][..block.body_length() as usize];
        assert_eq!(integer(&message[4..8]) + 8, block.meta_data_length() as usize);
        assert_eq!(block.offset() % 8 + i64::from(block.meta_data_length() % 8), 0);

        let message = MessageRef::read_as_root(&message[8..]).unwrap();
        let Some(MessageHeaderRef::RecordBatch(records)) = message.header().unwrap() else {
            panic!("the block is a record batch")
        };
        let lengths: Vec<_> = records.nodes().unwrap().unwrap().iter().map(|node| node.length()).collect();
        assert_eq!(lengths, [9, 27, 9, 9, 9]);
        let buffers: Vec<&[u8]> = (records.buffers().unwrap().unwrap().iter())
            .inspect(|buffer| assert_eq!(buffer.offset() % 64, 0))
            .map(|buffer| &body[buffer.offset() as usize..][..buffer.length() as usize])
            .collect();
        let expected: [&[u8]; 8] = [&[], &[], &[7; 108], &[], &[0, 1], &[], &[], &[5; 36]];
        assert_eq!(buffers, expected);
    }
}
