//! What a user would otherwise write: the same frames over a stream socket, encoded with bincode.
//!
//! The same drivers run over it. It is written as such a program decently would be: one length-prefixed
//! message per frame, one write per message, buffers reused, no delay on TCP.

use crate::encoding::{decode, encode_onto};
use crate::transport::{Frame, Inbox, Loan, Outbox, Slots, TransportError};
use ipc_schemas::{FrameHeader, Record};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::cell::RefCell;
use std::io::{Read, Write};
use std::marker::PhantomData;
use std::net::TcpStream;
use std::os::unix::net::UnixStream;
use std::rc::Rc;

/// A connected stream of either kind.
#[derive(Debug)]
pub(super) enum Stream {
    Unix(UnixStream),
    Tcp(TcpStream),
}

impl Read for Stream {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        match self {
            Stream::Unix(s) => s.read(buffer),
            Stream::Tcp(s) => s.read(buffer),
        }
    }
}

impl Write for Stream {
    fn write(&mut self, buffer: &[u8]) -> std::io::Result<usize> {
        match self {
            Stream::Unix(s) => s.write(buffer),
            Stream::Tcp(s) => s.write(buffer),
        }
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// One connection, shared by the boxes at its end.
#[derive(Clone, Debug)]
pub(super) struct Connection(Rc<RefCell<Stream>>);

impl Connection {
    pub(super) fn new(stream: Stream) -> Connection {
        Connection(Rc::new(RefCell::new(stream)))
    }

    pub(super) fn outbox<R>(&self) -> SocketOutbox<R> {
        SocketOutbox { connection: self.clone(), message: Vec::new(), records: Vec::new() }
    }

    pub(super) fn inbox<R>(&self) -> SocketInbox<R> {
        SocketInbox { connection: self.clone(), message: Vec::new(), records: PhantomData }
    }
}

fn failed(reason: &dyn std::fmt::Display) -> TransportError {
    TransportError::Failed { service: "socket".to_owned(), reason: reason.to_string() }
}

/// The sending end.
#[derive(Debug)]
pub(super) struct SocketOutbox<R> {
    connection: Connection,
    message: Vec<u8>,
    records: Vec<R>,
}

/// A frame being written.
#[derive(Debug)]
pub(super) struct SocketLoan<'a, R> {
    outbox: &'a mut SocketOutbox<R>,
    header: FrameHeader,
}

impl<R: Record + Serialize> Outbox<R> for SocketOutbox<R> {
    type Loan<'a> = SocketLoan<'a, R>;

    fn loan(
        &mut self,
        header: FrameHeader,
        count: usize,
        fill: impl FnOnce(&mut Slots<'_, R>),
    ) -> Result<SocketLoan<'_, R>, TransportError> {
        Slots::fill_vec(&mut self.records, count, fill);
        Ok(SocketLoan { outbox: self, header: FrameHeader { record_count: count as u32, ..header } })
    }
}

impl<R: Record + Serialize> Loan<R> for SocketLoan<'_, R> {
    fn records(&self) -> &[R] {
        &self.outbox.records
    }

    fn send(self) -> Result<usize, TransportError> {
        let SocketOutbox { connection, message, records } = self.outbox;
        message.clear();
        message.extend([0; 4]);
        encode_onto(message, &(&self.header, &*records));
        let length = (message.len() - 4) as u32;
        message[..4].copy_from_slice(&length.to_le_bytes());
        connection.0.borrow_mut().write_all(message).map_err(|e| failed(&e))?;
        Ok(1)
    }
}

/// The receiving end; receiving blocks until a message is there.
#[derive(Debug)]
pub(super) struct SocketInbox<R> {
    connection: Connection,
    message: Vec<u8>,
    records: PhantomData<R>,
}

/// A received frame.
#[derive(Debug)]
pub(super) struct SocketFrame<R> {
    header: FrameHeader,
    records: Vec<R>,
}

impl<R: Record + DeserializeOwned> Inbox<R> for SocketInbox<R> {
    type Frame = SocketFrame<R>;

    fn receive(&mut self) -> Result<Option<SocketFrame<R>>, TransportError> {
        let mut stream = self.connection.0.borrow_mut();
        let mut length = [0; 4];
        stream.read_exact(&mut length).map_err(|e| failed(&e))?;
        self.message.resize(u32::from_le_bytes(length) as usize, 0);
        stream.read_exact(&mut self.message).map_err(|e| failed(&e))?;
        let (header, records) = decode(&self.message).map_err(|e| failed(&e))?;
        Ok(Some(SocketFrame { header, records }))
    }
}

impl<R: Record> Frame<R> for SocketFrame<R> {
    fn header(&self) -> &FrameHeader {
        &self.header
    }

    fn records(&self) -> &[R] {
        &self.records
    }
}
