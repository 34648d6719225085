//! The command `psao`.

use clap::{Parser, Subcommand};
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use psao_server::bake::command::{self as bake, BakeArgs};
#[cfg(feature = "gpu")]
use psao_server::bench_gpu::{self, BenchGpuArgs};
use psao_server::commands::{self, InspectArgs, PlayArgs, RecordArgs, ServeArgs};
use psao_server::demo::{self, DemoArgs};
use psao_server::eval::{self, EvalArgs};
use std::collections::HashMap;
use std::io::Write;
use std::process::ExitCode;
use std::sync::Mutex;

/// Ray-traced ambient occlusion, streamed as points.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Streams a moving scene from a server to a client on this machine, and reports on it
    Demo(Box<DemoArgs>),
    /// Serves a scene to clients over QUIC
    Serve(Box<ServeArgs>),
    /// Records a scene's stream to a file
    Record(Box<RecordArgs>),
    /// Follows a recording or a live server, and checks it
    Play(PlayArgs),
    /// Lists what is in a recording
    Inspect(InspectArgs),
    /// Measures bits, error and time of the profiles on the same frames
    Eval(Box<EvalArgs>),
    /// Bakes occlusion into a scene's vertices or a texture, as points or as spherical harmonics
    Bake(Box<BakeArgs>),
    /// Races the lookup on the GPU against screen-space and ray-traced occlusion
    #[cfg(feature = "gpu")]
    BenchGpu(Box<BenchGpuArgs>),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    tracing_subscriber::fmt()
        .with_max_level(tracing::Level::WARN)
        .with_writer(std::io::stderr)
        .init();
    let bars = Bars::default();
    let progress = |stage: &str, done, total| bars.show(stage, done, total);
    let result = match &cli.command {
        Command::Demo(args) => demo::run(args, &progress).map(|figures| {
            bars.finish();
            let report = args.out.join("report.html");
            let report = format!("\nReport and pictures: {}\n", report.display());
            table(&figures.table()) + &report
        }),
        Command::Serve(args) => {
            commands::serve(args, &mut std::io::stdout(), &progress).map(|()| String::new())
        }
        Command::Record(args) => commands::record(args, &progress).map(|bytes| {
            bars.finish();
            format!("{}: {bytes} bytes\n", args.out.display())
        }),
        Command::Play(args) => commands::play(args).map(|rows| table(&rows)),
        Command::Inspect(args) => {
            commands::inspect(args, &mut std::io::stdout().lock()).map(|()| String::new())
        }
        Command::Eval(args) if !args.kernels.is_empty() => {
            eval::kernels::run(args, &progress).map(|found| {
                bars.finish();
                found.table()
            })
        }
        Command::Eval(args) => eval::run(args, &progress).map(|found| {
            bars.finish();
            found.table()
        }),
        Command::Bake(args) => bake::run(args, &progress).map(|report| {
            bars.finish();
            report.table()
        }),
        #[cfg(feature = "gpu")]
        Command::BenchGpu(args) => bench_gpu::run(args, &progress).map(|race| {
            bars.finish();
            race.table()
        }),
    };
    let result = result.and_then(|text| {
        let written = std::io::stdout().write_all(text.as_bytes());
        written.map_err(|error| format!("standard output: {error}"))
    });
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            bars.finish();
            eprintln!("psao: {error}");
            ExitCode::FAILURE
        }
    }
}

fn table(rows: &[(String, String)]) -> String {
    let width = rows.iter().map(|(what, _)| what.len()).max().unwrap_or(0);
    let lines = rows.iter();
    lines
        .map(|(what, value)| format!("{what:width$}  {value}\n"))
        .collect()
}

/// One progress bar a stage; where standard error is no terminal, a line a stage.
#[derive(Default)]
struct Bars {
    bars: MultiProgress,
    stages: Mutex<HashMap<String, ProgressBar>>,
}

impl Bars {
    fn show(&self, stage: &str, done: u64, total: u64) {
        let mut stages = self
            .stages
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        let bar = stages.entry(stage.to_string()).or_insert_with(|| {
            if self.bars.is_hidden() {
                eprintln!("{stage} ...");
            }
            let style =
                ProgressStyle::with_template("{prefix:>16} {wide_bar} {percent:>3} % {elapsed}");
            let bar = ProgressBar::new(total).with_prefix(stage.to_string());
            self.bars
                .add(bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar())))
        });
        bar.set_length(total);
        bar.set_position(done);
    }

    fn finish(&self) {
        let stages = self
            .stages
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        stages.values().for_each(|bar| bar.abandon());
    }
}
