"""All that this package uses of Hydra and OmegaConf beyond what they document, in one module.

pyproject.toml keeps both in a narrow range of versions; when one of them changes, this is the file
to mend. The rules for files of other people are not here: callers pass them as `Rules`.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra._internal.hydra as hydra_program
from hydra import version
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, IConfigRepository
from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus, setup_globals
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, RunMode, TaskFunction
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from omegaconf.grammar.gen.OmegaConfGrammarParser import OmegaConfGrammarParser
from omegaconf.grammar_parser import parse

from isaacgymenvs_lite.errors import ConfigError, JobError, SweepError, UserError, one_line
from isaacgymenvs_lite.paths import cfg_dir

CONFIG_NAME = "config"
# IsaacGymEnvs chose 1.1, which warns at every start. The two differ in what cfg/config.yaml states
# anyway: stay in the working directory, `_self_` in the defaults list.
HYDRA_VERSION_BASE = "1.3"

STUDIES = "study"
"""The group of cfg/ whose files set a sweeper: `+study=NAME`."""

NamedFiles = Mapping[str, Mapping[str, Path]]
"""Group -> name -> file, for files that are not in a folder of the search path."""

_NAMED_SCHEME = "outside"
_HYDRAS_OWN = "pkg://hydra.conf"
MAX_FILES = 200
"""Files of one composition, repeats included; the largest here has sixty."""
_NO_CIRCLE = "a file may name neither itself nor one of its own name in cfg/ (rename it)"
_HEADER_LENGTH = 512  # characters in which Hydra looks for `# @package`
# What Hydra writes down of a command line, below `hydra`.
_RECORDED = ("runtime", "overrides")
_RECORDED_OF_JOB = ("override_dirname", "config_name", "name")
_SWEEP_FILE = "multirun.yaml"  # of Hydra, in the folder of a sweep


# --- overrides ------------------------------------------------------------------------------------


def parse_overrides(words: Sequence[str]) -> list[Override]:
    """Return the overrides that words of a command line mean: `key=value`, `+key=value`, `~key`."""
    return OverridesParser.create().parse_overrides(list(words))


def apply_overrides(words: Sequence[str], cfg: DictConfig) -> None:
    """Change the keys of a composed tree as a command line would, in place."""
    ConfigLoaderImpl._apply_overrides_to_config(parse_overrides(words), cfg)


def quoted(text: str) -> str:
    """Return a text in quotes, as a command line has to write it if it holds blanks or commas."""
    return QuotedString(text=text, quote=Quote.single).with_quotes()


def options_parser() -> argparse.ArgumentParser:
    """Return the parser of Hydra's own options: --config-dir, --multirun, ..."""
    return get_args_parser()


# --- interpolations -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Interpolations:
    """What the interpolations in a text refer to.

    Attributes:
        paths: of other keys, as written: `a.b`, `..c`.
        resolvers: names of functions; a name that is put together of others is as written.
        has_composed_path: a path is put together of other interpolations: `${a.${b}}`.
    """

    paths: tuple[str, ...]
    resolvers: tuple[str, ...]
    has_composed_path: bool


@functools.lru_cache(maxsize=256)
def parse_interpolations(text: str) -> Interpolations:
    """Return what the interpolations in a text refer to.

    Raises:
        GrammarParseError: the text cannot be read.
        RecursionError: its interpolations are nested too deep.
    """
    nodes = list(_parts(parse(text)))
    paths = [part for part in nodes if isinstance(part, _Grammar.InterpolationNodeContext)]
    names = (part for part in nodes if isinstance(part, _Grammar.ResolverNameContext))
    return Interpolations(
        paths=tuple(part.getText()[2:-1].strip() for part in paths),
        resolvers=tuple(part.getText() for part in names),
        has_composed_path=any(
            isinstance(inner, _Grammar.InterpolationContext)
            for path in paths
            for child in _children(path)
            for inner in _parts(child)
        ),
    )


_Grammar = OmegaConfGrammarParser


def _parts(tree: Any) -> Iterator[Any]:
    """Yield a parsed text and everything in it."""
    yield tree
    for child in _children(tree):
        yield from _parts(child)


def _children(tree: Any) -> Sequence[Any]:
    return getattr(tree, "children", None) or ()


def allow_registering_again(names: Collection[str]) -> None:
    """Let the rest of the process register resolvers of these names again.

    OmegaConf refuses the second registration of a name.
    """
    register = OmegaConf.register_new_resolver

    @functools.wraps(register)
    def register_again(name: str, resolver: Callable[..., Any], **options: Any) -> None:
        register(name, resolver, **({"replace": True} if name in names else {}) | options)

    if not hasattr(register, "__wrapped__"):
        OmegaConf.register_new_resolver = register_again  # type: ignore[method-assign]


# --- files ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ComposedFile:
    """A configuration file as Hydra takes it.

    Attributes:
        config: what it holds.
        header: keys and values of lines such as `# @package _global_`.
    """

    config: DictConfig
    header: dict[str, str | None]


@dataclass(frozen=True)
class Rules:
    """What files may hold and do; see `foreign_files`.

    Attributes:
        read_file: reads a file of a group, '' for a root file.
        is_foreign: returns whether a file is not this project's own.
        check_tree: checks a tree with foreign files in it. Its arguments are the tree, the
            overrides, and whether a file has changed the section `hydra`.
    """

    read_file: Callable[[Path, str], ComposedFile]
    is_foreign: Callable[[Path], bool]
    check_tree: Callable[[DictConfig, Sequence[Override], bool], None]


def read_header(text: str, path: Path) -> dict[str, str | None]:
    """Return the comments for Hydra at the top of a file's text; `package` is always among them.

    Raises:
        ConfigError: they cannot be read.
    """
    try:
        return ConfigSource._get_header_dict(text[:_HEADER_LENGTH])
    except ValueError as error:
        raise ConfigError(f"{path}: {one_line(error)}") from error


class _Folder(FileConfigSource):
    """A folder of the search path whose files are read by the rules."""

    def __init__(self, rules: Rules, provider: str, path: str) -> None:
        super().__init__(provider, path)
        self._rules = rules

    def load_config(self, config_path: str) -> ConfigResult:
        """Read a file below the folder."""
        path = Path(self.path, self._normalize_file_name(config_path)).resolve()
        return self._read(path, config_path)

    def _read(self, path: Path, config_path: str) -> ConfigResult:
        file = self._rules.read_file(path, config_path.rpartition("/")[0])
        return ConfigResult(
            config=file.config,
            path=f"{self.scheme()}://{self.path}",
            provider=self.provider,
            header=file.header,
        )


class _NamedFolder(_Folder):
    """The folder of files that were named by their paths, as if it were a group.

    Args:
        rules: of the files.
        files: group -> name -> file; all files of a group are in one folder.
        provider: Hydra's.
        path: `outside://<group>`.
    """

    def __init__(self, rules: Rules, files: NamedFiles, provider: str, path: str) -> None:
        super().__init__(rules, provider, path)
        self._group = self.path
        self._named = files[self._group]
        self._folder = next(iter(self._named.values())).parent

    @staticmethod
    def scheme() -> str:
        return _NAMED_SCHEME

    def load_config(self, config_path: str) -> ConfigResult:
        return self._read(self._file(config_path), config_path)

    def is_group(self, config_path: str) -> bool:
        below = self._below(config_path)
        return config_path == "" or (below is not None and below.is_dir())

    def is_config(self, config_path: str) -> bool:
        return self._file(config_path).is_file()

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        return sorted(self._named) if config_path == self._group else []

    def _file(self, config_path: str) -> Path:
        group, _, name = config_path.rpartition("/")
        folder = self._below(group)
        if folder is None:
            return self._folder / "no such file"
        file = folder / f"{name.removesuffix('.yaml')}.yaml"
        return self._named.get(file.stem, file) if folder == self._folder else file

    def _below(self, group: str) -> Path | None:
        """Return the folder of a group, this one's or one below it; None for any other."""
        inside = group == self._group or group.startswith(f"{self._group}/")
        return self._folder / group[len(self._group) + 1 :] if inside else None


class _LimitedRepository(CachingConfigRepository):
    """The files of one composition; refuses more of them than anybody writes.

    Hydra loads a file again for every list that names it: a dozen small files that name each other
    twice take minutes.
    """

    def __init__(self, delegate: IConfigRepository) -> None:
        super().__init__(delegate)
        self._num_left = MAX_FILES

    def load_config(self, config_path: str) -> ConfigResult | None:
        """Load a file.

        Raises:
            ConfigError: it is one too many.
        """
        self._num_left -= 1
        if self._num_left < 0:
            raise ConfigError(
                f"{config_path}: the defaults lists of the configuration files run in a circle, or"
                f" name more than {MAX_FILES} files, repeats included; {_NO_CIRCLE}"
            )
        return super().load_config(config_path)


# --- composing ------------------------------------------------------------------------------------


class Loader(ConfigLoaderImpl):
    """Composes a tree as Hydra does; `rules` read its files and check what came out.

    Args:
        rules: of the files.
        files: these come before the files of all folders.
        config_search_path: Hydra's, see `loader_of_folders`.
    """

    def __init__(
        self, rules: Rules, files: NamedFiles, config_search_path: ConfigSearchPath
    ) -> None:
        self._rules, self._files = rules, files
        setup_globals()
        first = SearchPathQuery(path=_HYDRAS_OWN)
        for group in files:
            config_search_path.prepend(_NAMED_SCHEME, f"{_NAMED_SCHEME}://{group}", first)
        with self._readers():
            super().__init__(config_search_path)

    def is_group(self, name: str) -> bool:
        """Return whether a folder of configuration files has this name."""
        with self._readers():
            return self.repository.group_exists(name)

    def choices(self, group: str) -> list[str]:
        """Return the names of the files of a group."""
        with self._readers():
            return self.get_group_options(group)

    def compute_defaults_list(self, *args: Any, **kwargs: Any) -> Any:
        """Return what `--info defaults` prints; Hydra's program calls this."""
        with self._readers():
            return super().compute_defaults_list(*args, **kwargs)

    def compose(
        self, words: Sequence[str], config_name: str = CONFIG_NAME, *, sweeps: bool = False
    ) -> DictConfig:
        """Return the tree of the root file with overrides; `sweeps`: they may give several values.

        Raises:
            HydraException, OmegaConfBaseException, ValueError: see `hydra_errors.explain`.
            ConfigError: what a file of somebody else may not do, see `load_configuration`.
        """
        mode = RunMode.MULTIRUN if sweeps else RunMode.RUN
        return self.load_configuration(config_name, list(words), mode, from_shell=False)

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """Compose a tree; Hydra's program calls this.

        Hydra's section is compared with the one that cfg/config.yaml and the command line give
        alone: the second line of defence, whichever way a file has changed it.

        Raises:
            ConfigError: defaults lists run in a circle or cannot be used, or the rules refuse the
                tree.
        """
        rest = (run_mode, from_shell, validate_sweep_overrides)
        with self._readers():
            try:
                cfg = super().load_configuration(config_name, overrides, *rest)
            except RecursionError:
                raise ConfigError(
                    f"the defaults lists of the configuration files run in a circle; {_NO_CIRCLE}"
                ) from None
            except (HydraException, OmegaConfBaseException):
                raise  # their messages are for users, see `hydra_errors`
            except (AssertionError, AttributeError, KeyError, OSError, TypeError) as error:
                files = ", ".join(str(f) for named in self._files.values() for f in named.values())
                raise ConfigError(
                    f"{files or 'a configuration file'}: Hydra cannot compose it"
                    f" ({type(error).__name__}: {one_line(error)}); expected a defaults list of"
                    " names of files, and sections of keys and values"
                ) from error
            if any(self._is_foreign(source) for source in cfg.hydra.runtime.config_sources):
                parsed = parse_overrides(overrides)
                own = [str(word.input_line) for word in parsed if _is_about_hydra(word)]
                changes_hydra = _settings_of_hydra(cfg) != _own_settings(tuple(own), *rest)
                self._rules.check_tree(cfg, parsed, changes_hydra)
        return cfg

    @contextmanager
    def _readers(self) -> Iterator[None]:
        """Replace Hydra's reader of folders, and its version base, in the whole process.

        Both come back afterwards, so other Hydra programs in the process are safe.
        """
        Plugins.instance()  # registers Hydra's own readers, which must happen before
        readers: dict[str, Any] = SourcesRegistry.instance().types
        base = version.VersionBase.instance()
        module: Any = config_loader_impl
        former_repository = module.CachingConfigRepository
        former_readers, former_base = dict(readers), base.version_base
        readers[FileConfigSource.scheme()] = functools.partial(_Folder, self._rules)
        readers[_NAMED_SCHEME] = functools.partial(_NamedFolder, self._rules, self._files)
        module.CachingConfigRepository = _LimitedRepository
        version.setbase(HYDRA_VERSION_BASE)
        try:
            yield
        finally:
            module.CachingConfigRepository = former_repository
            readers.clear()
            readers.update(former_readers)
            base.version_base = former_base

    def _is_foreign(self, source: Any) -> bool:
        """Return whether an entry of the search path is not the project's own or Hydra's."""
        if source.schema == "pkg":
            return f"pkg://{source.path}" != _HYDRAS_OWN
        return source.schema != "structured" and (
            source.schema != "file" or self._rules.is_foreign(Path(source.path))
        )


def loader_of_folders(
    rules: Rules, files: NamedFiles, folder: Path | str, first: Path | None = None
) -> Loader:
    """Return a loader over a folder of configuration files, and over another one before it."""
    search_path = create_config_search_path(str(folder))
    if first is not None:
        search_path.prepend("config_dir", f"file://{first}", SearchPathQuery("schema", None))
    return Loader(rules, files, search_path)


@contextmanager
def program_composes_by(rules: Rules, files: NamedFiles) -> Iterator[None]:
    """Let Hydra's program, `hydra.main`, compose with `Loader` as long as the context lasts."""
    program: Any = hydra_program
    former = program.ConfigLoaderImpl
    program.ConfigLoaderImpl = functools.partial(Loader, rules, files)
    try:
        yield
    finally:
        program.ConfigLoaderImpl = former


# --- sweeps ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class JobResult:
    """What became of one job of a sweep.

    Attributes:
        number: of the job, from 0.
        words: its overrides, without the section `hydra`.
        value: what the job's function returned; None if it raised.
        error: what the job's function raised; None if it returned.
    """

    number: int
    words: tuple[str, ...]
    value: Any
    error: Exception | None


class _ReportingLauncher(Launcher):
    """Launches jobs as another launcher does, reports their results, and keeps failures apart.

    Hydra's own sweeper ends at the first failure. It gets None as the result of a failed job. A
    sweeper with a limit of its own, `max_failure_rate`, gets the failures.

    Args:
        launcher: the other one.
        report: receives the results of a batch.
        waiting: a context for jobs that run in other processes.
    """

    def __init__(
        self,
        launcher: Launcher,
        report: Callable[[list[JobResult]], None],
        waiting: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self._launcher, self._report = launcher, report
        runs_here = isinstance(launcher, BasicLauncher)
        self._waiting = contextlib.nullcontext if runs_here else waiting
        self._sweeper_counts_failures = self._has_run = False
        self._folder = Path()

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Read the settings of the sweep; the other launcher is set up already."""
        self._folder = Path(config.hydra.sweep.dir)
        self._sweeper_counts_failures = "max_failure_rate" in config.hydra.sweeper

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run a batch of jobs.

        Raises:
            JobError: the launcher itself has failed, such as a process that was killed.
            SweepError: of a job.
        """
        self._has_run = True
        with self._waiting():
            returns = self._launch(job_overrides, initial_job_idx)
            results = [_result_of(job, n) for n, job in enumerate(returns, initial_job_idx)]
            for result in results:
                if isinstance(result.error, SweepError):
                    self._has_run = False
                    raise result.error
            self._report(results)
        for job in returns:
            if job.status == JobStatus.FAILED and not self._sweeper_counts_failures:
                job.status, job.return_value = JobStatus.COMPLETED, None
        return returns

    def _launch(self, job_overrides: Sequence[Sequence[str]], first: int) -> Sequence[JobReturn]:
        try:
            return self._launcher.launch(job_overrides, initial_job_idx=first)
        except (HydraException, OmegaConfBaseException, UserError, ValueError):
            raise  # composing a job; `hydra_errors` explains it
        except Exception as error:
            raise JobError(
                f"{type(self._launcher).__name__} has failed: {type(error).__name__}:"
                f" {one_line(error)}; of this batch of jobs only their run folders are left"
            ) from error

    def remove_unused_folder(self) -> None:
        """Remove the sweep's folder if it is empty, or has only Hydra's file and no job has run."""
        with contextlib.suppress(OSError):
            files = {file.name for file in self._folder.iterdir()}
            if files == {_SWEEP_FILE} and not self._has_run:
                (self._folder / _SWEEP_FILE).unlink()
            self._folder.rmdir()


@contextmanager
def sweeps_report_to(
    report: Callable[[list[JobResult]], None],
    waiting: Callable[[], AbstractContextManager[None]],
) -> Iterator[None]:
    """Let the sweeps of Hydra's program report their jobs as long as the context lasts.

    A job that fails does not end the others; see `_ReportingLauncher`, also for the arguments.
    """
    plugins: Any = Plugins.instance()
    make = plugins.instantiate_launcher
    made: list[_ReportingLauncher] = []

    def make_reporting(**context: Any) -> Launcher:
        launcher = _ReportingLauncher(make(**context), report, waiting)
        launcher.setup(**context)
        made.append(launcher)
        return launcher

    plugins.instantiate_launcher = make_reporting
    try:
        yield
    finally:
        del plugins.instantiate_launcher
        for launcher in made:
            launcher.remove_unused_folder()


def _result_of(job: JobReturn, number: int) -> JobResult:
    # Not its property `return_value`, which prints and raises.
    value, failed = job._return_value, job.status == JobStatus.FAILED
    words = tuple(w for w in job.overrides or () if not w.startswith(("hydra.", "hydra/")))
    return JobResult(number, words, None if failed else value, value if failed else None)


def _is_about_hydra(word: Override) -> bool:
    """Return whether a word sets something of Hydra, as the studies of cfg/ do."""
    package = (word.package or "").removeprefix("_global_.")
    return (
        word.is_hydra_override() or package.split(".")[0] == "hydra" or word.key_or_group == STUDIES
    )


@functools.lru_cache(maxsize=32)
def _own_settings(overrides: tuple[str, ...], *rest: Any) -> Any:
    """Return Hydra's settings as cfg/config.yaml and the command line alone give them."""
    try:
        loader = ConfigLoaderImpl(create_config_search_path(str(cfg_dir())))
        return _settings_of_hydra(loader.load_configuration(CONFIG_NAME, list(overrides), *rest))
    except (HydraException, OmegaConfBaseException, ValueError):
        return None  # an override of Hydra's section that needs a file from outside


def _settings_of_hydra(cfg: DictConfig) -> Any:
    settings: Any = OmegaConf.to_container(cfg.hydra, resolve=False)
    for key in _RECORDED:
        settings.pop(key, None)
    for key in _RECORDED_OF_JOB:
        settings["job"].pop(key, None)
    return settings
