//! Asking robots on the mesh.

use std::future::Future;
use std::time::Duration;

use anyhow::{Context as _, anyhow, bail};
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::serving::ALIVE;
use zenoh::Session;
use zenoh::bytes::ZBytes;
use zenoh::query::{ConsolidationMode, QueryTarget};

/// A daemon answers from memory; this is for the network.
const PATIENCE: Duration = Duration::from_secs(5);

/// Runs what needs a session, on the runtime that Zenoh needs.
pub(super) fn block_on<T>(work: impl Future<Output = anyhow::Result<T>>) -> anyhow::Result<T> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("client")
        .enable_all()
        .build()
        .context("cannot start threads")?
        .block_on(work)
}

/// What a robot answered.
#[derive(Debug)]
pub(super) struct Answer {
    pub(super) bytes: Vec<u8>,
    /// As Zenoh tells it.
    pub(super) encoding: String,
}

/// What became of a question.
#[derive(Debug)]
pub(super) enum Outcome {
    Answered(Answer),
    /// Somebody was asked, and gave no answer in time.
    Silence,
    /// There is nobody to ask.
    Nobody,
}

/// Asks for a key, with parameters behind a question mark; `None` if nobody answers.
///
/// An answer that says what is wrong is an error with these words.
pub(super) async fn ask(session: &Session, selector: &str) -> anyhow::Result<Option<Answer>> {
    match ask_within(session, selector, PATIENCE).await? {
        Outcome::Answered(answer) => Ok(Some(answer)),
        Outcome::Silence | Outcome::Nobody => Ok(None),
    }
}

/// As [`ask`], for an answer that may take so long.
pub(super) async fn ask_within(
    session: &Session,
    selector: &str,
    limit: Duration,
) -> anyhow::Result<Outcome> {
    let replies = session.get(selector).timeout(limit).await;
    let replies = replies.map_err(|error| anyhow!(error)).context("cannot ask")?;
    let mut outcome = Outcome::Nobody;
    while let Ok(reply) = replies.recv_async().await {
        match reply.result() {
            Ok(sample) => {
                let encoding = sample.encoding().to_string();
                return Ok(Outcome::Answered(Answer { bytes: owned(sample.payload()), encoding }));
            }
            // Nobody's words, but those of the session that stopped waiting.
            Err(error) if error.payload().try_to_string().is_ok_and(|text| text == "Timeout") => {
                outcome = Outcome::Silence;
            }
            Err(error) => bail!("{}", String::from_utf8_lossy(&error.payload().to_bytes())),
        }
    }
    Ok(outcome)
}

/// Asks for a key of a robot; nobody answering is an error that tells who would.
pub(super) async fn ask_robot(
    session: &Session,
    robot: &Prefix,
    question: (&str, &str),
) -> anyhow::Result<Answer> {
    match ask(session, &selector(robot, question)?).await? {
        Some(answer) => Ok(answer),
        None => Err(nobody_answers(robot, question.0, &alive(session).await?)),
    }
}

/// A key of a robot with its parameters.
pub(super) fn selector(robot: &Prefix, (name, parameters): (&str, &str)) -> anyhow::Result<String> {
    let key = robot.key(name)?;
    Ok(if parameters.is_empty() { key.to_string() } else { format!("{key}?{parameters}") })
}

/// What is wrong when a robot does not answer to a key, with those who would.
pub(super) fn nobody_answers(robot: &Prefix, name: &str, alive: &[Prefix]) -> anyhow::Error {
    let slash = if robot.to_string().is_empty() { "" } else { "/" };
    anyhow!("nobody answers on {robot}{slash}{name}; {}", remedy(alive))
}

/// The answers of all robots to a key, with the robots that gave them; errors are passed over.
pub(super) async fn ask_all(
    session: &Session,
    name: &str,
) -> anyhow::Result<Vec<(Prefix, Answer)>> {
    let replies = session
        .get(format!("**/{name}"))
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        .timeout(PATIENCE)
        .await
        .map_err(|error| anyhow!(error))
        .context("cannot ask")?;
    let mut answers = Vec::new();
    while let Ok(reply) = replies.recv_async().await {
        let Ok(sample) = reply.result() else { continue };
        if let Some(robot) = robot_of(sample.key_expr().as_str(), name) {
            let encoding = sample.encoding().to_string();
            answers.push((robot, Answer { bytes: owned(sample.payload()), encoding }));
        }
    }
    Ok(answers)
}

/// The robots whose daemons are alive, in the order of their names.
pub(super) async fn alive(session: &Session) -> anyhow::Result<Vec<Prefix>> {
    let replies = session.liveliness().get(format!("**/{ALIVE}")).timeout(PATIENCE).await;
    let replies = replies.map_err(|error| anyhow!(error)).context("cannot ask who is alive")?;
    let mut robots = Vec::new();
    while let Ok(reply) = replies.recv_async().await {
        let key = reply.result().map(|sample| sample.key_expr().to_string());
        robots.extend(key.ok().and_then(|key| robot_of(&key, ALIVE)));
    }
    robots.sort_by_key(Prefix::to_string);
    robots.dedup();
    Ok(robots)
}

/// The robot that was named, or the only one that is alive.
pub(super) async fn choose(session: &Session, named: Option<&str>) -> anyhow::Result<Prefix> {
    if let Some(name) = named {
        return Ok(Prefix::parse(name)?);
    }
    let mut robots = alive(session).await?;
    match (robots.pop(), robots.len()) {
        (Some(robot), 0) => Ok(robot),
        (None, _) => bail!("no robot is named, and {}", remedy(&[])),
        (Some(last), _) => {
            robots.push(last);
            bail!("several robots are alive: {}; name one of them", names(&robots))
        }
    }
}

/// A robot's name for people.
pub(super) fn name(robot: &Prefix) -> String {
    let name = robot.to_string();
    if name.is_empty() { "\"\"".to_owned() } else { name }
}

fn names(robots: &[Prefix]) -> String {
    robots.iter().map(name).collect::<Vec<_>>().join(", ")
}

fn remedy(alive: &[Prefix]) -> String {
    if alive.is_empty() {
        "no gmapd is alive on this mesh: start gmapd run, or name the way to it with \
         -e tcp/HOST:PORT"
            .to_owned()
    } else {
        format!("alive are: {}", names(alive))
    }
}

/// The robot whose key ends with `name`.
pub(super) fn robot_of(key: &str, name: &str) -> Option<Prefix> {
    let prefix = key.strip_suffix(name)?;
    let is_whole = prefix.is_empty() || prefix.ends_with('/');
    Prefix::parse(prefix).ok().filter(|_| is_whole)
}

fn owned(payload: &ZBytes) -> Vec<u8> {
    payload.to_bytes().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_does_not_answer_in_time_is_told_from_nobody() {
        let config = r#"{ mode: "peer", listen: { endpoints: [] }, scouting: {
            multicast: { enabled: false }, gossip: { enabled: false } } }"#;
        block_on(async {
            let session = zenoh::open(zenoh::Config::from_json5(config).unwrap()).await.unwrap();
            let (sender, asked) = std::sync::mpsc::channel();
            let keep = move |query| drop(sender.send(query));
            session.declare_queryable("slow").callback(keep).background().await.unwrap();
            let limit = Duration::from_millis(50);
            let outcome = ask_within(&session, "slow", limit).await?;
            assert!(matches!(outcome, Outcome::Silence), "{outcome:?}");
            let outcome = ask_within(&session, "none", limit).await?;
            assert!(matches!(outcome, Outcome::Nobody), "{outcome:?}");
            drop(asked);
            session.close().await.map_err(|error| anyhow!(error))
        })
        .unwrap();
    }

    #[test]
    fn a_key_tells_whose_it_is() {
        let robot = |key| robot_of(key, ALIVE).map(|robot| robot.to_string());
        assert_eq!(robot("robot01/slam/alive").as_deref(), Some("robot01"));
        assert_eq!(robot("site/a/slam/alive").as_deref(), Some("site/a"));
        assert_eq!(robot("slam/alive").as_deref(), Some(""));
        assert_eq!(robot("robot01/islam/alive"), None);
        assert_eq!(robot("robot01/slam/status"), None);
    }

    #[test]
    fn who_has_no_name_is_shown_as_it_is_typed() {
        let robots = ["", "robot01"].map(|name| Prefix::parse(name).unwrap());
        assert_eq!(names(&robots), "\"\", robot01");
    }
}
