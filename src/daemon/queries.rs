//! The queryables: every query gets an answer or one sentence that says why not.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::runtime::Handle;
use tokio::sync::{Semaphore, mpsc, oneshot};
use tokio::task::{JoinHandle, spawn_blocking};
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::query::{Query, Queryable};
use zenoh::{Session, Wait as _};

use super::answers::{Answer, Refusal, Responder};
use super::limits::{InFlight, Limits, Rate, Reason, Refusals, Room};
use super::ros_node::RosNode;
use super::selector::Topic;
use super::serving::ServingError;
use crate::clock;
use crate::ros::graph::GET_MAP;
use crate::ros::graph::rmw_zenoh::Attachment;

/// Maps that go out at once: one after the other, half of those who ask together have theirs in
/// half of the time, and nobody waits longer.
const TURNS: usize = 2;

/// A client that does not read an answer in this time gives its turn on, while its reply goes on.
const LONGEST_TURN: Duration = Duration::from_millis(50);

/// Commands that are done at once; they have their own places, for they wait for the filter.
const COMMANDS_AT_ONCE: usize = 8;

/// Queries beyond those that wait to hear that they are too many; more end without a reply.
const REFUSALS_WAITING: usize = 1024;

/// Bytes of parameters that a query may have to wait for that.
const LONGEST_WAITING: usize = 1024;

/// Who asks on a key, and so what a reply has to bring.
#[derive(Debug, Clone, Copy)]
enum Asker {
    /// Anybody.
    Mesh,
    /// A client of a ROS 2 service, by `rmw_zenoh`: its request's number and its own id.
    RosNode,
}

/// What a robot answers, while this lives.
#[derive(Debug)]
pub(super) struct Queryables {
    declared: Vec<Queryable<()>>,
    counter: Counter,
    queries_at_once: u32,
    refusing: JoinHandle<()>,
}

/// Where queries are taken in.
///
/// Zenoh's receiving threads call it, so nothing here may block: an answer is made and sent on a
/// thread for blocking work, for a reply to a slow client blocks too.
#[derive(Debug, Clone)]
struct Counter {
    responder: Arc<Responder>,
    answers: Arc<Semaphore>,
    turns: Arc<Semaphore>,
    commands: Arc<Semaphore>,
    refused: mpsc::Sender<Query>,
    limits: Arc<Limits>,
    rate: Arc<Rate>,
    in_flight: Arc<InFlight>,
    refusals: Arc<Refusals>,
    runtime: Handle,
}

impl Queryables {
    /// Declares the queryable of each topic, and that of the service as ROS 2 nodes ask it.
    pub(super) async fn declare(
        session: &Session,
        node: &mut RosNode,
        responder: Arc<Responder>,
        limits: Limits,
        refusals: Arc<Refusals>,
    ) -> Result<Self, ServingError> {
        let (refused, waiting) = mpsc::channel(REFUSALS_WAITING);
        let queries_at_once = limits.queries_at_once;
        let counter = Counter {
            responder,
            answers: Arc::new(Semaphore::new(queries_at_once)),
            turns: Arc::new(Semaphore::new(TURNS)),
            commands: Arc::new(Semaphore::new(COMMANDS_AT_ONCE)),
            refused,
            refusals,
            rate: Arc::new(Rate::new(limits.commands_per_second)),
            in_flight: InFlight::new(limits.max_bytes_in_flight),
            limits: Arc::new(limits),
            runtime: Handle::current(),
        };
        let mut declared = Vec::new();
        for topic in Topic::ALL {
            let key = node.prefix().key(topic.name())?;
            declared.push(counter.declare(session, topic, key, Asker::Mesh).await?);
        }
        let topic = Topic::DynamicMap;
        if let Some(key) = node.service(topic.name(), GET_MAP)? {
            declared.push(counter.declare(session, topic, key, Asker::RosNode).await?);
        }
        let refusing = tokio::spawn(refuse_all(waiting, queries_at_once));
        Ok(Self { declared, counter, queries_at_once: queries_at_once as u32, refusing })
    }

    /// Takes no more queries, and waits until those that came are answered.
    pub(super) async fn stop(self) {
        let Self { declared, counter, queries_at_once, refusing } = self;
        // It blocks while the network is slow.
        let undeclare = move || {
            for queryable in declared {
                if let Err(error) = queryable.undeclare().wait() {
                    tracing::debug!(%error, "a queryable could not be undeclared");
                }
            }
        };
        spawn_blocking(undeclare).await.ok();
        counter.answers.acquire_many(queries_at_once).await.ok();
        counter.commands.acquire_many(COMMANDS_AT_ONCE as u32).await.ok();
        refusing.abort();
    }
}

impl Counter {
    async fn declare(
        &self,
        session: &Session,
        topic: Topic,
        key: OwnedKeyExpr,
        asker: Asker,
    ) -> Result<Queryable<()>, ServingError> {
        let (counter, own_key) = (self.clone(), key.clone());
        let queryable = session
            .declare_queryable(key.clone())
            .complete(true)
            .callback(move |query| counter.take(topic, own_key.clone(), asker, query))
            .await;
        queryable.map_err(|source| ServingError::Declare { key, source })
    }

    fn take(&self, topic: Topic, key: OwnedKeyExpr, asker: Asker, mut query: Query) {
        // No answer depends on it, and it may be large.
        if let Some(payload) = query.payload_mut() {
            *payload = ZBytes::new();
        }
        let places = if topic.command().is_some() { &self.commands } else { &self.answers };
        let Ok(place) = places.clone().try_acquire_owned() else {
            let reason = match topic.command() {
                Some(_) => Reason::TooManyCommands,
                None => Reason::TooManyQueries,
            };
            self.refusals.note(reason, &"too many come at once", clock::now());
            let may_wait = query.parameters().as_str().len() <= LONGEST_WAITING;
            if !may_wait || self.refused.try_send(query).is_err() {
                tracing::debug!(%key, "a query ends without a reply: too many come at once");
            }
            return;
        };
        let counter = self.clone();
        let answering = move |built: oneshot::Sender<()>| {
            let answer = counter.answer(topic, &query);
            // Whoever has no turn does not listen.
            built.send(()).ok();
            if let Err(refusal) = &answer
                && let Some(reason) = refusal.reason()
            {
                counter.refusals.note(reason, refusal, clock::now());
            }
            let (answer, room) = answer.map_or_else(
                |refusal| (Err(refusal), None),
                |(answer, room)| (Ok(asker.sign(answer, &query)), Some(room)),
            );
            reply(&query, &key, answer);
            drop(room);
            // Whoever asked is told that nothing more comes before the place is free again.
            drop(query);
            drop(place);
        };
        if topic.is_large() {
            self.runtime.spawn(in_turn(self.turns.clone(), answering));
        } else {
            self.runtime.spawn_blocking(move || answering(oneshot::channel().0));
        }
    }

    /// The answer, and its room among those that are on their way.
    fn answer(&self, topic: Topic, query: &Query) -> Result<(Answer, Room), Refusal> {
        let limits = &self.limits;
        if let Some(command) = topic.command() {
            if query.key_expr().is_wild() {
                return Err(Refusal::Wildcard(topic.name()));
            }
            if !limits.commands.contains(&command) {
                return Err(Refusal::SwitchedOff(topic.name()));
            }
        }
        let question = topic.question(query.parameters().as_str())?;
        if topic.command().is_some() && !self.rate.admits(clock::now()) {
            return Err(Refusal::TooManyCommands(limits.commands_per_second));
        }
        let answer = self.responder.answer(&question)?;
        let bytes = answer.payloads.iter().map(Bytes::len).sum();
        if bytes > limits.max_reply_bytes {
            return Err(Refusal::TooLarge { bytes, most: limits.max_reply_bytes });
        }
        let most = limits.max_bytes_in_flight;
        let room = self.in_flight.room(bytes);
        let room = room.map_err(|bytes| Refusal::TooManyBytes { bytes, most })?;
        Ok((answer, room))
    }
}

/// First come, first served. A turn lasts until the answer is built, however long that takes: so
/// few are in memory at once that nobody reads yet.
async fn in_turn(
    turns: Arc<Semaphore>,
    answering: impl FnOnce(oneshot::Sender<()>) + Send + 'static,
) {
    let turn = turns.acquire_owned().await;
    let (built, ready) = oneshot::channel();
    let sent = spawn_blocking(move || answering(built));
    ready.await.ok();
    tokio::time::timeout(LONGEST_TURN, sent).await.ok();
    drop(turn);
}

impl Asker {
    /// A node takes the reply to its own request only. Who asks without an attachment is no node.
    fn sign(self, answer: Answer, query: &Query) -> Answer {
        let attachment = match self {
            Self::Mesh => return answer,
            Self::RosNode => query.attachment().map(|bytes| bytes.to_bytes()),
        };
        let request = attachment.and_then(|bytes| Attachment::from_bytes(&bytes));
        let reply =
            request.map(|request| Attachment { sent_ns: clock::unix_nanoseconds(), ..request });
        Answer { attachment: reply.map(|reply| reply.to_bytes().to_vec().into()), ..answer }
    }
}

/// Blocks until the transport has taken the reply.
fn reply(query: &Query, key: &OwnedKeyExpr, answer: Result<Answer, Refusal>) {
    let sent = match answer {
        Ok(answer) => answer.payloads.into_iter().try_for_each(|payload| {
            let reply = query.reply(key, payload).encoding(answer.encoding.clone());
            reply.attachment(answer.attachment.clone()).wait()
        }),
        Err(refusal) => query.reply_err(refusal.to_string()).encoding(Encoding::TEXT_PLAIN).wait(),
    };
    match sent {
        Ok(()) => tracing::debug!(selector = %query.selector(), "answered"),
        Err(error) => tracing::debug!(selector = %query.selector(), %error, "not answered"),
    }
}

/// One after the other, so that clients that do not read cost one thread.
async fn refuse_all(mut waiting: mpsc::Receiver<Query>, queries_at_once: usize) {
    while let Some(query) = waiting.recv().await {
        let refuse = move || {
            let refusal = Refusal::TooMany(queries_at_once).to_string();
            query.reply_err(refusal).encoding(Encoding::TEXT_PLAIN).wait().ok();
        };
        spawn_blocking(refuse).await.ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_turn_lasts_until_the_answer_is_built_and_little_longer() {
        let turns = Arc::new(Semaphore::new(1));
        let (build, wait_to_build) = std::sync::mpsc::channel::<()>();
        let (read, wait_to_read) = std::sync::mpsc::channel::<()>();
        let first = tokio::spawn(in_turn(turns.clone(), move |built| {
            wait_to_build.recv().ok();
            built.send(()).ok();
            wait_to_read.recv().ok();
        }));
        let (began, mut second) = oneshot::channel();
        tokio::task::yield_now().await;
        tokio::spawn(in_turn(turns, move |_built| began.send(()).unwrap()));
        tokio::time::sleep(4 * LONGEST_TURN).await;
        assert!(second.try_recv().is_err(), "the first is not built");
        build.send(()).unwrap();
        second.await.expect("its turn comes though the first is not read");
        read.send(()).unwrap();
        first.await.unwrap();
    }
}
