//! A run that goes on, in a terminal: zones, processes, how long steps take.

use clap::Parser;
use control_zones::process::{Notice, Place, Steering, Watched};
use control_zones::scenario::Scenario;
use control_zones::step::Step;
use control_zones::transport::iox::{Condition, RunName, clean};
use ipc_schemas::{ASSIGNMENT_FREE_TERMINAL, VehicleState};
use ratatui::Frame;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph, Row, Sparkline, Table};
use std::collections::{BTreeMap, VecDeque};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Watch a run in the terminal: zones, vehicles, step times, processes.
///
/// q ends it. Of a run started with --steered: space pauses it or lets it go on, s makes one step, + and - change its pace.
#[derive(Debug, Parser)]
#[command(name = "cz top", version)]
struct Top {
    /// The run's name [default: the one run there is].
    #[arg(value_name = "RUN")]
    pub run: Option<RunName>,
    /// Print the board once, as text, after so many seconds, and end.
    #[arg(long, value_name = "SECONDS")]
    pub once: Option<f64>,
}

/// Time between two pictures.
const TICK: Duration = Duration::from_millis(200);
/// Time between two looks for steps.
const LOOK: Duration = Duration::from_millis(2);
/// Step times kept, of the last steps.
const RECENT: usize = 2000;
/// Pictures of which the rate is kept.
const RATES: usize = 200;

/// `cz-top`.
pub fn top() -> ExitCode {
    match watch(&Top::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(problem) => {
            eprintln!("cz top: {problem}");
            ExitCode::from(2)
        }
    }
}

fn watch(args: &Top) -> Result<(), String> {
    let name = match &args.run {
        Some(name) => name.clone(),
        None => only_run()?,
    };
    let deadline = Instant::now() + Duration::from_secs(2);
    let (watched, metadata, scenario) = loop {
        match Watched::find(&name).map_err(|error| error.to_string())? {
            Some(opened) => break opened,
            None if Instant::now() >= deadline => {
                return Err(format!("there is no run {name} that can be looked at"));
            }
            None => std::thread::sleep(Duration::from_millis(20)),
        }
    };
    let mut board = Board::new(name.to_string(), metadata.seed, scenario);
    if let Some(seconds) = args.once {
        let until = Instant::now() + Duration::from_secs_f64(seconds.clamp(0.0, 3600.0));
        while Instant::now() < until && !board.is_over {
            board.gather(&watched)?;
            std::thread::sleep(LOOK);
        }
        board.sample();
        print!("{}", board.text(120, 40));
        return Ok(());
    }
    // Also puts the terminal right again when this ends or panics.
    let mut terminal = ratatui::try_init().map_err(|error| format!("cannot use the terminal: {error}"))?;
    let result = live(&mut terminal, &watched, &mut board);
    ratatui::restore();
    result
}

/// The name of the one run that goes on.
fn only_run() -> Result<RunName, String> {
    let found = clean(true).map_err(|error| error.to_string())?;
    let alive: Vec<String> =
        found.into_iter().filter(|run| run.condition == Condition::Alive).map(|run| run.name).collect();
    match &alive[..] {
        [] => Err("no run goes on".to_owned()),
        [name] => name.parse().map_err(|error| format!("run {name}: {error}")),
        several => Err(format!("several runs go on, say which: {}", several.join(", "))),
    }
}

fn live(terminal: &mut ratatui::DefaultTerminal, watched: &Watched, board: &mut Board) -> Result<(), String> {
    let failed = |error: std::io::Error| format!("cannot use the terminal: {error}");
    loop {
        board.sample();
        terminal.draw(|frame| board.draw(frame)).map_err(failed)?;
        let next = Instant::now() + TICK;
        while Instant::now() < next {
            board.gather(watched)?;
            if event::poll(LOOK).map_err(failed)?
                && let Event::Key(key) = event::read().map_err(failed)?
                && key.kind == KeyEventKind::Press
            {
                match board.key(key) {
                    Reaction::End => return Ok(()),
                    Reaction::Steer(wish) => {
                        watched.steer(&wish).map_err(|error| error.to_string())?;
                    }
                    Reaction::None => {}
                }
            }
        }
    }
}

/// What a key does.
#[derive(Debug, PartialEq)]
enum Reaction {
    End,
    Steer(Steering),
    None,
}

/// One zone's line.
#[derive(Clone, Debug, Default, PartialEq)]
struct ZoneLine {
    name: String,
    n: usize,
    mean_mps: f64,
    waiting: usize,
    /// Terminal speeds by exit, in words.
    v_m: Vec<String>,
}

/// One process's line.
#[derive(Clone, Debug)]
struct ProcessLine {
    place: Place,
    core: Option<u32>,
    share: f64,
    resident_mib: f64,
}

/// What is shown.
struct Board {
    run: String,
    seed: u64,
    scenario: Arc<Scenario>,
    step: u64,
    vehicles: usize,
    verdicts: [usize; 6],
    zones: Vec<ZoneLine>,
    processes: Vec<ProcessLine>,
    notice: Notice,
    recent_us: VecDeque<f32>,
    rates: VecDeque<u64>,
    skipped: u64,
    last: Option<(Instant, u64)>,
    times: BTreeMap<u32, (Instant, u64)>,
    rate_per_s: f64,
    is_over: bool,
}

impl Board {
    fn new(run: String, seed: u64, scenario: Arc<Scenario>) -> Board {
        let zone = |zone: &control_zones::scenario::Zone| ZoneLine {
            name: zone.name.clone(),
            v_m: vec!["–".to_owned(); zone.exits.len()],
            ..ZoneLine::default()
        };
        let zones = scenario.network.zones.iter().map(zone).collect();
        Board {
            run,
            seed,
            scenario,
            step: 0,
            vehicles: 0,
            verdicts: [0; 6],
            zones,
            processes: Vec::new(),
            notice: Notice::default(),
            recent_us: VecDeque::new(),
            rates: VecDeque::new(),
            skipped: 0,
            last: None,
            times: BTreeMap::new(),
            rate_per_s: 0.0,
            is_over: false,
        }
    }

    /// Takes what has come.
    fn gather(&mut self, watched: &Watched) -> Result<(), String> {
        let failed = |error: control_zones::process::ProcessError| error.to_string();
        let goes_on = watched.goes_on();
        while let Some((_, block)) = watched.step().map_err(failed)? {
            if let Ok(step) = Step::decode(block.bytes()) {
                self.take_step(&step);
            }
        }
        while let Some(notice) = watched.notice().map_err(failed)? {
            self.take_notice(notice);
        }
        self.is_over |= !goes_on;
        Ok(())
    }

    fn take_step(&mut self, step: &Step) {
        let number = step.header.step;
        if self.vehicles + self.step as usize > 0 && number > self.step + 1 {
            self.skipped += number - self.step - 1;
        }
        self.step = number;
        self.is_over |= step.header.flags & ipc_schemas::FLAG_END_OF_RUN != 0;
        let present = || step.state.iter().filter(|s| !s.has_left());
        self.vehicles = present().count();
        self.verdicts = [0; 6];
        for command in step.commands.iter().flat_map(|part| &part.records) {
            if let Some(count) = self.verdicts.get_mut(usize::from(command.verdict)) {
                *count += 1;
            }
        }
        for zone in &mut self.zones {
            (zone.n, zone.mean_mps, zone.waiting) = (0, 0.0, 0);
        }
        for state in present() {
            if let Some(zone) = self.zones.get_mut(state.zone as usize) {
                zone.n += 1;
                zone.mean_mps += state.v_mps;
                zone.waiting += usize::from(state.v_mps < 0.1);
            }
        }
        self.zones.iter_mut().filter(|zone| zone.n > 0).for_each(|zone| zone.mean_mps /= zone.n as f64);
        for assignment in &step.coordination {
            let own = |s: &&VehicleState| s.zone == assignment.zone && s.vehicle == assignment.vehicle;
            let Some(state) = present().find(own) else { continue };
            let Some(shape) = self.scenario.network.zones.get(state.zone as usize) else { continue };
            let Some(path) = shape.paths.get(state.path as usize) else { continue };
            let is_free = assignment.flags & ASSIGNMENT_FREE_TERMINAL != 0;
            let told =
                if is_free { "free".to_owned() } else { format!("{:.1}", assignment.terminal_speed_mps) };
            if let Some(v_m) = self.zones[state.zone as usize].v_m.get_mut(path.exit as usize) {
                *v_m = told;
            }
        }
    }

    fn take_notice(&mut self, notice: Notice) {
        self.recent_us.extend(notice.latency_us.iter().copied());
        let surplus = self.recent_us.len().saturating_sub(RECENT);
        self.recent_us.drain(..surplus);
        self.notice = notice;
    }

    /// Looks at the clock and at the processes.
    fn sample(&mut self) {
        let now = Instant::now();
        if let Some((then, step)) = self.last {
            let seconds = (now - then).as_secs_f64().max(1e-6);
            self.rate_per_s = self.step.saturating_sub(step) as f64 / seconds;
            self.rates.push_back(self.rate_per_s as u64);
            if self.rates.len() > RATES {
                self.rates.pop_front();
            }
        }
        self.last = Some((now, self.step));
        let (times, mut processes) = (&mut self.times, Vec::new());
        for place in &self.notice.members {
            let Some((ticks, core)) = process_times(place.process_id) else { continue };
            let before = times.insert(place.process_id, (now, ticks));
            let share = before.map_or(0.0, |(then, before)| {
                let seconds = (now - then).as_secs_f64();
                if seconds > 0.0 { ticks.saturating_sub(before) as f64 / TICKS_PER_S / seconds } else { 0.0 }
            });
            processes.push(ProcessLine {
                place: place.clone(),
                core: Some(core),
                share,
                resident_mib: resident_mib(place.process_id),
            });
        }
        self.processes = processes;
    }

    /// Step times: median, 99th percentile, greatest, us.
    fn percentiles(&self) -> Option<[f32; 3]> {
        let mut sorted: Vec<f32> = self.recent_us.iter().copied().collect();
        sorted.sort_by(f32::total_cmp);
        let at = |share: f64| {
            sorted.get(((sorted.len() as f64 * share) as usize).min(sorted.len().saturating_sub(1)))
        };
        Some([*at(0.5)?, *at(0.99)?, *sorted.last()?])
    }

    fn key(&self, key: KeyEvent) -> Reaction {
        let pace = self.notice.pace;
        let steer = |order| if self.notice.is_steered { Reaction::Steer(order) } else { Reaction::None };
        match key.code {
            KeyCode::Char('q') | KeyCode::Esc => Reaction::End,
            KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => Reaction::End,
            KeyCode::Char(' ') => {
                steer(if self.notice.is_paused { Steering::Resume } else { Steering::Pause })
            }
            KeyCode::Char('s') => steer(Steering::Step(1)),
            KeyCode::Char('+') => {
                steer(Steering::Pace(if pace == 0.0 { 1.0 } else { (pace * 2.0).min(1000.0) }))
            }
            KeyCode::Char('-') => {
                steer(Steering::Pace(if pace == 0.0 { 1.0 } else { (pace / 2.0).max(0.01) }))
            }
            _ => Reaction::None,
        }
    }

    fn draw(&self, frame: &mut Frame<'_>) {
        let zones = (self.zones.len() as u16 + 2).min(frame.area().height / 2);
        let areas = Layout::vertical([
            Constraint::Length(4),
            Constraint::Length(5),
            Constraint::Length(zones.max(3)),
            Constraint::Min(3),
            Constraint::Length(1),
        ])
        .split(frame.area());
        self.draw_head(frame, areas[0]);
        self.draw_rate(frame, areas[1]);
        self.draw_zones(frame, areas[2]);
        self.draw_processes(frame, areas[3]);
        let keys = match self.notice.is_steered {
            true => "q end   space pause   s step   + - pace",
            false => "q end",
        };
        frame.render_widget(Paragraph::new(keys).style(QUIET), areas[4]);
    }

    fn draw_head(&self, frame: &mut Frame<'_>, area: Rect) {
        let bold = Style::new().add_modifier(Modifier::BOLD);
        let how = match (&self.notice, self.is_over) {
            (_, true) => Span::styled("over", QUIET),
            (notice, _) if notice.is_paused => Span::styled("paused", Style::new().fg(Color::Yellow)),
            (notice, _) if notice.pace > 0.0 => Span::raw(format!("{:.4} × real time", notice.pace)),
            _ => Span::raw("as fast as it can"),
        };
        let time_s = self.scenario.time_s(self.step);
        let first = Line::from(vec![
            Span::styled(self.run.clone(), bold),
            Span::styled(format!("  {}, seed {}  ", self.scenario.name, self.seed), QUIET),
            how,
        ]);
        let mut second = vec![
            Span::styled(format!("step {}", self.step), bold),
            Span::raw(format!("  {time_s:.1} s  {} vehicles  {:.0} steps/s", self.vehicles, self.rate_per_s)),
        ];
        if let Some([p50, p99, max]) = self.percentiles() {
            second.push(Span::raw(format!("  step p50 {p50:.1} µs, p99 {p99:.1}, max {max:.1}")));
        }
        let counts = [
            ("as wished", 0),
            ("FE", 1),
            ("bound", 2),
            ("infeasible", 3),
            ("held", 4),
            ("held by shield", 5),
        ];
        let verdict = |(name, at): (&str, usize)| {
            let is_bad = at >= 3 && self.verdicts[at] > 0;
            let style = if is_bad { BAD } else { Style::new() };
            Span::styled(format!("{name} {}  ", self.verdicts[at]), style)
        };
        let third = Line::from(counts.into_iter().map(verdict).collect::<Vec<_>>());
        let notice = &self.notice;
        let mut fourth = Vec::new();
        let mut say = |count: u64, what: &str| {
            if count > 0 {
                fourth.push(Span::styled(format!("{count} {what}  "), BAD));
            }
        };
        say(notice.missed_steps, "deadlines missed");
        say(notice.late_frames, "answers late");
        say(notice.refused.len() as u64, "senders refused");
        say(self.skipped, "steps not seen");
        frame.render_widget(Paragraph::new(vec![first, Line::from(second), third, Line::from(fourth)]), area);
    }

    fn draw_rate(&self, frame: &mut Frame<'_>, area: Rect) {
        let width = area.width as usize;
        let data: Vec<u64> =
            self.rates.iter().skip(self.rates.len().saturating_sub(width)).copied().collect();
        let most = data.iter().copied().max().unwrap_or(0);
        let block = Block::new().title(format!("steps/s, up to {most}")).title_style(QUIET);
        frame.render_widget(
            Sparkline::default().block(block).data(&data).style(Style::new().fg(Color::Blue)),
            area,
        );
    }

    fn draw_zones(&self, frame: &mut Frame<'_>, area: Rect) {
        let rows = self.zones.iter().map(|zone| {
            let mean = if zone.n > 0 { format!("{:.1}", zone.mean_mps) } else { "–".to_owned() };
            Row::new([
                zone.name.clone(),
                zone.n.to_string(),
                zone.v_m.join(" "),
                mean,
                zone.waiting.to_string(),
            ])
        });
        let widths = [16, 6, 24, 10, 10].map(Constraint::Length);
        let head = Row::new(["zone", "N", "v_m [m/s]", "mean v", "standing"]).style(QUIET);
        frame.render_widget(Table::new(rows, widths).header(head), area);
    }

    fn draw_processes(&self, frame: &mut Frame<'_>, area: Rect) {
        let rows = self.processes.iter().map(|line| {
            Row::new([
                line.place.name.clone(),
                line.place.process_id.to_string(),
                line.core.map_or_else(|| "–".to_owned(), |core| core.to_string()),
                format!("{:.0} %", line.share * 100.0),
                format!("{:.1}", line.resident_mib),
                line.place.generation.to_string(),
            ])
        });
        let widths = [24, 9, 6, 8, 9, 11].map(Constraint::Length);
        let head = Row::new(["process", "id", "core", "cpu", "MiB", "generation"]).style(QUIET);
        frame.render_widget(Table::new(rows, widths).header(head), area);
    }

    /// The board as text of that size.
    fn text(&self, width: u16, height: u16) -> String {
        let backend = ratatui::backend::TestBackend::new(width, height);
        let mut terminal = ratatui::Terminal::new(backend).expect("a buffer can be drawn on");
        terminal.draw(|frame| self.draw(frame)).expect("a buffer can be drawn on");
        let buffer = terminal.backend().buffer();
        let line = |y: u16| {
            (0..width).map(|x| buffer[(x, y)].symbol()).collect::<String>().trim_end().to_owned() + "\n"
        };
        let lines: Vec<String> = (0..height).map(line).collect();
        let kept = lines.iter().rposition(|line| line != "\n").map_or(0, |last| last + 1);
        lines[..kept].concat()
    }
}

const QUIET: Style = Style::new().fg(Color::DarkGray);
const BAD: Style = Style::new().fg(Color::Red).add_modifier(Modifier::BOLD);

/// Unit of the times in `/proc`, 1/s; it has been 100 on Linux for as long as programs could see it.
const TICKS_PER_S: f64 = 100.0;

/// Time a process has run, in ticks, and the core it is on; see proc_pid_stat(5).
fn process_times(process_id: u32) -> Option<(u64, u32)> {
    let text = std::fs::read_to_string(format!("/proc/{process_id}/stat")).ok()?;
    // Behind the name, which may hold anything.
    let fields: Vec<&str> = text.rsplit_once(')')?.1.split_whitespace().collect();
    let number = |at: usize| fields.get(at - 3)?.parse::<u64>().ok();
    Some((number(14)? + number(15)?, number(39)? as u32))
}

fn resident_mib(process_id: u32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{process_id}/status")).unwrap_or_default();
    let kib = status
        .lines()
        .find_map(|l| l.strip_prefix("VmRSS:")?.trim().strip_suffix("kB")?.trim().parse::<f64>().ok());
    kib.unwrap_or(0.0) / 1024.0
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use control_zones::lockstep::in_process::InProcess;
    use control_zones::record::Step as Kept;
    use control_zones::scenario::{Override, load_embedded};

    /// The board after so many steps of the paper's setting.
    fn board(steps: u64) -> (Board, Kept) {
        let none: [Override; 0] = [];
        let scenario = Arc::new(load_embedded("paper", &none, None).unwrap());
        let mut run = InProcess::observed(&scenario, 1, 1);
        let mut board = Board::new("test".to_owned(), 1, scenario);
        let mut last = None;
        for _ in 0..steps {
            run.step().unwrap();
            run.frames(|frames| {
                let mut bytes = Vec::new();
                frames.encode_onto(&mut bytes);
                let step = Kept::decode(&bytes).unwrap();
                board.take_step(&step);
                last = Some(step);
            })
            .unwrap();
        }
        (board, last.unwrap())
    }

    #[test]
    fn the_board_says_what_the_step_holds() {
        let (mut board, step) = board(1500);
        board.take_notice(Notice {
            step: 1500,
            latency_us: (1..=100).map(|us| us as f32).collect(),
            members: vec![
                Place { name: "world".to_owned(), process_id: std::process::id(), generation: 0 },
                Place { name: "controller 0".to_owned(), process_id: std::process::id(), generation: 3 },
            ],
            missed_steps: 7,
            is_steered: true,
            is_paused: true,
            ..Notice::default()
        });
        board.sample();
        let text = board.text(100, 30);
        let line = |begin: &str| {
            text.lines().find(|line| line.starts_with(begin)).unwrap_or_else(|| panic!("{begin}\n{text}"))
        };
        let inside = step.state.iter().filter(|s| !s.has_left());
        assert!(
            line("step 1499").contains(&format!("149.9 s  {} vehicles", inside.clone().count())),
            "{text}"
        );
        assert!(line("step 1499").contains("p50 51.0 µs, p99 100.0, max 100.0"), "{text}");
        let merge_1 = inside.filter(|s| s.zone == 0).count();
        let fields: Vec<&str> = line("merge-1").split_whitespace().collect();
        assert_eq!(fields[1], merge_1.to_string(), "{text}");
        assert!(merge_1 > 3, "{text}");
        // A fixed terminal speed, and one that follows the traffic.
        assert_eq!(line("merge-2").split_whitespace().nth(2), Some("18.5"), "{text}");
        assert!(fields[2].parse::<f64>().unwrap() <= 18.0, "{text}");
        let of = |verdict: u16| {
            step.commands.iter().flat_map(|part| &part.records).filter(|c| c.verdict == verdict).count()
        };
        assert!(
            line("as wished").starts_with(&format!("as wished {}  FE {}  bound {}", of(0), of(1), of(2))),
            "{text}"
        );
        assert!(line("7 deadlines missed").contains('7'));
        assert_eq!(line("controller 0").split_whitespace().last(), Some("3"), "{text}");
        assert!(line("test").contains("paused"), "{text}");
    }

    #[test]
    fn keys_steer_only_a_run_that_may_be_steered() {
        let (mut board, _) = board(1);
        let press = |code| KeyEvent::new(code, KeyModifiers::NONE);
        assert_eq!(board.key(press(KeyCode::Char('q'))), Reaction::End);
        assert_eq!(board.key(press(KeyCode::Char(' '))), Reaction::None);
        board.notice.is_steered = true;
        assert_eq!(board.key(press(KeyCode::Char(' '))), Reaction::Steer(Steering::Pause));
        board.notice.is_paused = true;
        assert_eq!(board.key(press(KeyCode::Char(' '))), Reaction::Steer(Steering::Resume));
        assert_eq!(board.key(press(KeyCode::Char('s'))), Reaction::Steer(Steering::Step(1)));
        board.notice.pace = 1.0;
        assert_eq!(board.key(press(KeyCode::Char('+'))), Reaction::Steer(Steering::Pace(2.0)));
    }
}
