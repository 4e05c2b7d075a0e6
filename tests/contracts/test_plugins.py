"""Every file in every plug-in folder keeps the contract of its kind, without being listed anywhere."""

import inspect
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from ctlev_core import plugin_contracts, plugins
from ctlev_core.plugins import PluginError
from data_contracts.config import DatasetChoice, Frozen, MetricChoice

CONDITIONS_BY_NEEDS = {
    "": plugin_contracts.Condition,
    "intensity": plugin_contracts.ConditionOfPairs,
    "motion": plugin_contracts.ConditionOfMotions,
    "displacement": plugin_contracts.ConditionOfDisplacements,
}
WITHOUT_OPTIONS = ("formats", "motions")
ALL = [(kind, name) for kind in plugins.KINDS for name in plugins.names(kind)]


def protocol_of(kind, module):
    """The contract of a kind; a condition says by `NEEDS`, a generator by its functions, which of several it keeps."""
    if kind == "conditions":
        return CONDITIONS_BY_NEEDS[module.NEEDS]
    return next(protocol for protocol in plugin_contracts.BY_KIND[kind] if isinstance(module, protocol))


def functions_of(protocol):
    return [(n, f) for n, f in inspect.getmembers(protocol, inspect.isfunction) if not n.startswith("_")]


EXTENDED = [
    protocol
    for protocol in vars(plugin_contracts).values()
    if inspect.isclass(protocol) and protocol.__module__ == plugin_contracts.__name__
    and protocol not in [kept for several in plugin_contracts.BY_KIND.values() for kept in several]
]  # fmt: skip


def keyword_only(function):
    parameters = inspect.signature(function).parameters.values()
    return [parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY]


@pytest.mark.parametrize(("kind", "name"), ALL)
def test_module_keeps_its_protocol(kind, name):
    module = plugins.load(kind, name)
    protocol = protocol_of(kind, module)
    assert isinstance(module.VERSION, int) and module.VERSION >= 1
    assert module.__doc__
    assert isinstance(module, protocol)
    for attribute in protocol.__annotations__:
        assert hasattr(module, attribute), f"{kind}/{name} lacks {attribute}"
    for function_name, expected in functions_of(protocol):
        function = getattr(module, function_name)
        assert function.__doc__, f"{kind}/{name}.{function_name} has no docstring"
        wanted = list(inspect.signature(expected).parameters)[1:]
        assert list(inspect.signature(function).parameters)[: len(wanted)] == wanted, f"{kind}/{name}.{function_name}"
        assert keyword_only(function) == keyword_only(expected), f"{kind}/{name}.{function_name}"


@pytest.mark.parametrize("protocol", EXTENDED, ids=lambda protocol: protocol.__name__)
def test_what_only_some_plugins_can_do_is_done_as_the_protocol_says(protocol):
    """Callers ask by `isinstance`, which looks at names alone."""
    modules = [plugins.load(kind, name) for kind, name in ALL]
    able = [module for module in modules if isinstance(module, protocol)]
    assert able, "no plug-in can do this"
    for module in able:
        for name, expected in functions_of(protocol):
            wanted = [(p.name, p.kind) for p in list(inspect.signature(expected).parameters.values())[1:]]
            found = [(p.name, p.kind) for p in inspect.signature(getattr(module, name)).parameters.values()]
            assert found[: len(wanted)] == wanted, f"{module.__name__}.{name}"


@pytest.mark.parametrize("protocol", EXTENDED, ids=lambda protocol: protocol.__name__)
def test_nothing_half_done(protocol):
    """A plug-in with one function of a Protocol that adds several is asked for none of them: one is misnamed."""
    added = {name for name in vars(protocol) if inspect.isfunction(getattr(protocol, name))} - {"__init__"}
    added = {name for name in added if not name.startswith("_")}
    for kind, name in ALL:
        module = plugins.load(kind, name)
        if set(plugin_contracts.BY_KIND[kind]) & set(protocol.__mro__) and len(added) > 1:
            assert len([one for one in added if hasattr(module, one)]) in (0, len(added)), f"{kind}/{name}"


@pytest.mark.parametrize("name", plugins.names("generators"))
def test_a_generator_makes_frames_or_events_and_not_both(name):
    """Callers tell the two apart by `sample_events`; a module with half of each contract would fail late."""
    module = plugins.load("generators", name)
    functions = [f for f in ("train", "sample", "base_model_folders", "sample_events") if hasattr(module, f)]
    assert functions in (["train", "sample", "base_model_folders"], ["sample_events"])


@pytest.mark.parametrize("name", plugins.names("conditions"))
def test_a_condition_asks_for_no_more_than_it_needs(name):
    module = plugins.load("conditions", name)
    protocol = CONDITIONS_BY_NEEDS[module.NEEDS]
    wanted = list(inspect.signature(protocol.render).parameters)[1:]
    assert list(inspect.signature(module.render).parameters) == wanted


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, name in ALL if kind not in WITHOUT_OPTIONS])
def test_options_are_frozen_documented_and_have_defaults(kind, name):
    module = plugins.load(kind, name)
    models = [module.Options, *([module.SampleOptions] if kind == "generators" else [])]
    for model in models:
        assert issubclass(model, Frozen)
        for field, info in model.model_fields.items():
            assert info.description, f"{kind}/{name}: option {field} has no description"
    required = {"root": "."} if kind == "datasets" and "root" in module.Options.model_fields else {}
    assert module.Options(**required) == module.Options(**required)


@pytest.mark.parametrize("name", plugins.names("motions"))
def test_motion_formats_that_assume_a_rate_take_another(name):
    module = plugins.load("motions", name)
    rate = inspect.signature(module.read).parameters.get("rate_hz")
    assert (rate is not None) == hasattr(module, "RATE_HZ")
    assert rate is None or rate.default == module.RATE_HZ > 0


def test_planning_imports_are_light():
    """The plan of an experiment loads every plug-in; it must not wait for torch."""
    code = """
        import sys
        from ctlev_core import plugins
        for kind in plugins.KINDS:
            for name in plugins.names(kind):
                plugins.load(kind, name)
        print(sorted({"torch", "numba", "cv2", "diffusers", "transformers", "scipy", "prefect"} & set(sys.modules)))
    """
    import textwrap

    result = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_unknown_names_list_the_known_ones():
    with pytest.raises(PluginError, match=r"unknown plug-in 'fid' in metrics; known: .*mpjpe2d"):
        plugins.load_options(MetricChoice(name="fid"))
    with pytest.raises(PluginError, match="unknown plug-in kind 'metric'; known kinds: datasets, formats"):
        plugins.names("metric")


@pytest.mark.parametrize("name", ["__init__", "studio.sys", "../datasets/studio", ""])
def test_only_names_of_plugins_are_loaded(name):
    plugins.load("datasets", "studio")
    with pytest.raises(PluginError, match="unknown plug-in"):
        plugins.load("datasets", name)


def test_a_plugin_is_looked_for_once(monkeypatch):
    module = plugins.load("datasets", "studio")
    monkeypatch.setattr(plugins, "names", lambda kind: pytest.fail("its folder was read again"))
    assert plugins.load("datasets", "studio") is module


def test_threads_that_load_a_plugin_at_once_get_it_whole(tmp_path, monkeypatch):
    import ctlev_core.metrics

    text = "import time\ntime.sleep(0.5)\nINPUT, SCORES, Options, compute = 'classes', (), None, None\nVERSION = 1\n"
    (tmp_path / "slow_metric.py").write_text(text)
    monkeypatch.setattr(ctlev_core.metrics, "__path__", [*ctlev_core.metrics.__path__, str(tmp_path)])
    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(plugins.load, "metrics", "slow_metric")
        while "ctlev_core.metrics.slow_metric" not in sys.modules:
            time.sleep(0.01)
        second = threads.submit(lambda: plugins.load("metrics", "slow_metric").VERSION)
        assert second.result() == first.result().VERSION == 1
    del sys.modules["ctlev_core.metrics.slow_metric"]


def test_what_a_plugin_lacks_is_named(tmp_path, monkeypatch):
    import ctlev_core.metrics

    (tmp_path / "half_metric.py").write_text("VERSION = 1\nINPUT = 'classes'\nSCORES = ()\nOptions = None\n")
    monkeypatch.setattr(ctlev_core.metrics, "__path__", [*ctlev_core.metrics.__path__, str(tmp_path)])
    for _ in range(2):  # it is imported by then, and incomplete all the same
        with pytest.raises(PluginError, match=r"half_metric.py: expected the names of Metric in .*, lacks compute$"):
            plugins.load("metrics", "half_metric")
    del sys.modules["ctlev_core.metrics.half_metric"]


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Write the entry points of an installed package that has a metric `always_one`."""
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "__init__.py").write_text("")
    (tmp_path / "my_package" / "one.py").write_text(
        "from data_contracts.config import Frozen\nVERSION = 7\nINPUT = 'classes'\nSCORES = ()\n"
        "class Options(Frozen):\n    pass\ndef compute(predicted, target, options):\n    return {'one': 1.0}\n"
    )
    monkeypatch.syspath_prepend(tmp_path)

    def offer(text):
        (tmp_path / "my_package-1.0.dist-info").mkdir(exist_ok=True)
        (tmp_path / "my_package-1.0.dist-info" / "METADATA").write_text("Name: my-package\nVersion: 1.0\n")
        (tmp_path / "my_package-1.0.dist-info" / "entry_points.txt").write_text(f"[ctlev.metrics]\n{text}\n")
        forget()

    def forget():
        for function in (plugins.installed, plugins.versions):
            function.cache_clear()

    yield offer
    monkeypatch.undo()
    forget()


def test_installed_packages_offer_plugins(package):
    package("always_one = my_package.one")
    assert "always_one" in plugins.names("metrics") and plugins.versions("metrics")["always_one"] == 7
    plugin = plugins.load_options(MetricChoice(name="always_one"))
    assert plugin.module.compute(None, None, plugin.options) == {"one": 1.0} and plugin.version == 7


@pytest.mark.parametrize(
    ("offered", "message"),
    [
        ("frechet = my_package.one", "metrics/frechet: offered by my_package.one, and bundled; one must be renamed"),
        ("always_one = my_package.one:compute", r"expected NAME = MODULE, the name an identifier"),
        ("always-one = my_package.one", r"entry point always-one = 'my_package.one': expected NAME = MODULE"),
    ],
)
def test_entry_points_that_name_no_plugin_are_refused(package, offered, message):
    package(offered)
    with pytest.raises(PluginError, match=message):
        plugins.names("metrics")


def test_every_wrong_option_is_named_at_once():
    choice = DatasetChoice(name="folder", options={"root": ".", "test_fraction": 2, "colour": 1})
    with pytest.raises(PluginError) as error:
        plugins.load_options(choice)
    assert "'test_fraction'" in str(error.value) and "unknown option 'colour'; known: root" in str(error.value)
