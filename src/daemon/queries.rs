//! The queryables: every query gets an answer or one sentence that says why not.

use std::sync::Arc;

use tokio::runtime::Handle;
use tokio::sync::{Semaphore, mpsc};
use tokio::task::{JoinHandle, spawn_blocking};
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::query::{Query, Queryable};
use zenoh::{Session, Wait as _};

use super::answers::{Answer, Refusal, Responder};
use super::keys::Prefix;
use super::selector::Topic;
use super::serving::ServingError;

/// Queries that are answered at once. A reply to a slow client holds its place until it is sent.
const ANSWERS_AT_ONCE: usize = 64;

/// Commands that are done at once; they have their own places, for they wait for the filter.
const COMMANDS_AT_ONCE: usize = 8;

/// Queries beyond those that wait to hear that they are too many; more end without a reply.
const REFUSALS_WAITING: usize = 1024;

/// Bytes of parameters that a query may have to wait for that.
const LONGEST_WAITING: usize = 1024;

/// What a robot answers, while this lives.
#[derive(Debug)]
pub(super) struct Queryables {
    declared: Vec<Queryable<()>>,
    counter: Counter,
    refusals: JoinHandle<()>,
}

/// Where queries are taken in.
///
/// Zenoh's receiving threads call it, so nothing here may block: an answer is made and sent on a
/// thread for blocking work, for a reply to a slow client blocks too.
#[derive(Debug, Clone)]
struct Counter {
    responder: Arc<Responder>,
    answers: Arc<Semaphore>,
    commands: Arc<Semaphore>,
    refused: mpsc::Sender<Query>,
    runtime: Handle,
}

impl Queryables {
    /// Declares the queryable of each topic.
    pub(super) async fn declare(
        session: &Session,
        prefix: &Prefix,
        responder: Arc<Responder>,
    ) -> Result<Self, ServingError> {
        let (refused, waiting) = mpsc::channel(REFUSALS_WAITING);
        let counter = Counter {
            responder,
            answers: Arc::new(Semaphore::new(ANSWERS_AT_ONCE)),
            commands: Arc::new(Semaphore::new(COMMANDS_AT_ONCE)),
            refused,
            runtime: Handle::current(),
        };
        let mut declared = Vec::new();
        for topic in Topic::ALL {
            let key = prefix.key(topic.name())?;
            let counter = counter.clone();
            let own_key = key.clone();
            let queryable = session
                .declare_queryable(key.clone())
                .complete(true)
                .callback(move |query| counter.take(topic, own_key.clone(), query))
                .await;
            declared.push(queryable.map_err(|source| ServingError::Declare { key, source })?);
        }
        let refusals = tokio::spawn(refuse_all(waiting));
        Ok(Self { declared, counter, refusals })
    }

    /// Takes no more queries, and waits until those that came are answered.
    pub(super) async fn stop(self) {
        let Self { declared, counter, refusals } = self;
        // It blocks while the network is slow.
        let undeclare = move || {
            for queryable in declared {
                if let Err(error) = queryable.undeclare().wait() {
                    tracing::debug!(%error, "a queryable could not be undeclared");
                }
            }
        };
        spawn_blocking(undeclare).await.ok();
        counter.answers.acquire_many(ANSWERS_AT_ONCE as u32).await.ok();
        counter.commands.acquire_many(COMMANDS_AT_ONCE as u32).await.ok();
        refusals.abort();
    }
}

impl Counter {
    fn take(&self, topic: Topic, key: OwnedKeyExpr, mut query: Query) {
        // No answer depends on it, and it may be large.
        if let Some(payload) = query.payload_mut() {
            *payload = ZBytes::new();
        }
        let places = if topic.is_command() { &self.commands } else { &self.answers };
        let Ok(place) = places.clone().try_acquire_owned() else {
            let may_wait = query.parameters().as_str().len() <= LONGEST_WAITING;
            if !may_wait || self.refused.try_send(query).is_err() {
                tracing::debug!(%key, "a query ends without a reply: too many come at once");
            }
            return;
        };
        let responder = self.responder.clone();
        self.runtime.spawn_blocking(move || {
            reply(&query, &key, answer(&responder, topic, &query));
            // Whoever asked is told that nothing more comes before the place is free again.
            drop(query);
            drop(place);
        });
    }
}

fn answer(responder: &Responder, topic: Topic, query: &Query) -> Result<Answer, Refusal> {
    if topic.is_command() && query.key_expr().is_wild() {
        return Err(Refusal::Wildcard(topic.name().to_owned()));
    }
    responder.answer(&topic.question(query.parameters().as_str())?)
}

/// Blocks until the transport has taken the reply.
fn reply(query: &Query, key: &OwnedKeyExpr, answer: Result<Answer, Refusal>) {
    let sent = match answer {
        Ok(answer) => {
            let reply = query.reply(key, answer.payload).encoding(answer.encoding);
            reply.attachment(answer.attachment).wait()
        }
        Err(refusal) => query.reply_err(refusal.to_string()).encoding(Encoding::TEXT_PLAIN).wait(),
    };
    match sent {
        Ok(()) => tracing::debug!(selector = %query.selector(), "answered"),
        Err(error) => tracing::debug!(selector = %query.selector(), %error, "not answered"),
    }
}

/// One after the other, so that clients that do not read cost one thread.
async fn refuse_all(mut waiting: mpsc::Receiver<Query>) {
    while let Some(query) = waiting.recv().await {
        let refuse = move || {
            let refusal = Refusal::TooMany(ANSWERS_AT_ONCE).to_string();
            query.reply_err(refusal).encoding(Encoding::TEXT_PLAIN).wait().ok();
        };
        spawn_blocking(refuse).await.ok();
    }
}
