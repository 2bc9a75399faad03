//! The door of a port: every call, the health service's too, shows a token before a service sees it.

use std::sync::Arc;

use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::{Request, Status};

use crate::connection::Peer;
use crate::metrics::{Metrics, Reason};
use crate::reload::Reloaded;
use crate::token::{Tokens, presented};

/// Lets in calls with a token of the file, or all where there is none.
#[derive(Clone)]
pub(crate) struct Door {
    pub(crate) tokens: Option<Arc<Reloaded<Tokens>>>,
    pub(crate) metrics: Metrics,
}

impl Door {
    /// Why a call with this `authorization` is not let in, and what to do about it.
    fn objection(&self, authorization: Option<MetadataValue<Ascii>>) -> Option<&'static str> {
        let tokens = self.tokens.as_ref()?;
        match authorization.as_ref().and_then(|header| presented(header.as_encoded_bytes())) {
            None => {
                Some("this port wants a token: set security.token_file to a file with this service's token")
            }
            Some(token) if tokens.current().accept(token) => None,
            Some(_) => {
                Some("this port wants another token: security.token_file must hold this service's token")
            }
        }
    }
}

impl Interceptor for Door {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        // Removed: a service has no use for it, and cannot pass it on.
        let authorization = request.metadata_mut().remove("authorization");
        let peer = request.extensions().get::<Peer>().cloned();
        if let Some(why) = self.objection(authorization) {
            self.metrics.refuse(Reason::Token, peer.and_then(|peer| peer.tcp.remote_addr), why);
            return Err(Status::unauthenticated(why));
        }
        if let Some(peer) = peer {
            peer.admit();
            // Where `Request::remote_addr` looks.
            request.extensions_mut().insert(peer.tcp);
        }
        Ok(request)
    }
}
