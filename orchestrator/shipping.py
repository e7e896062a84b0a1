"""One run's way into MLflow: the lines of metrics.jsonl in batches and in order, then how it ended.

Why no step is lost or doubled, whatever dies when:

* what MLflow has is asked of MLflow: `iteration` is a metric of every step, the last of its step to be sent. Steps up
  to the last one are skipped. A SQL store (all that `mlflow server` runs on) takes a batch in one transaction;
* a batch may arrive later than we learn of it: the answer was lost, or the process that sent it was killed. So each is
  noted in the run's folder before it is sent, and sent again as it was before anything else: the primary key of
  MLflow's metrics is (run, key, step, timestamp, value), which makes a second arrival nothing. To make the batch again
  from metrics.jsonl would not do: a run that repeats iterations writes the same numbers with other clock times.
* the end is marked by the last call, which sets status and end time to those noted in the folder.
"""

import json
import math
from pathlib import Path

from orchestrator import mlflow_store, model_registry, spool
from orchestrator.folder import metrics_path

BATCH = 1000  # values per call, MLflow's limit
NOTE = "table.md"  # a sweep's table is also the text at the head of its page
LONGEST_TAG = 8000  # characters, MLflow's limit


class Shipper:
    """Ships one run's folder. Every method may raise whatever the store raises; then make a new Shipper and go on.

    spec: `mlflow_store.RunSpec`. experiment: its experiment's name. shipped: last step that MLflow has; new: how many
    steps this shipper sent.
    """

    def __init__(self, uri, experiment, spec):
        self._spec, self._offset, self._last_line, self.new = spec, 0, b"", 0
        client = mlflow_store.make_client(uri)
        experiment_id = mlflow_store.ensure_experiment(client, uri, experiment)
        self._experiment = experiment, experiment_id
        self.run_id = mlflow_store.ensure_run(client, uri, experiment_id, spec)
        self._client = client
        mlflow_store.log_params(client, self.run_id, spec.params)
        self.shipped = self._steps_there()
        on_its_way = spool.read_batch(spec.folder, self.run_id)
        if on_its_way and on_its_way[-1][3] > self.shipped:
            self._send(on_its_way)
            self.new += len({step for key, _, _, step in on_its_way if key == "iteration"})
            self.shipped = self._steps_there()

    def _steps_there(self):
        return int(self._client.get_run(self.run_id).data.metrics.get("iteration", 0))

    def running(self):
        """Say that the run goes on."""
        self._client.update_run(self.run_id, status="RUNNING")

    def ship(self):
        """Send all whole lines of metrics.jsonl, and samples of the machine's load, that MLflow does not have."""
        path = metrics_path(self._spec.folder)
        while path.exists() and (batch := self._next_batch(path)):
            values, offset, last_line, steps = batch
            if values:
                spool.record_batch(self._spec.folder, self.run_id, values)
                self._send(values)
                self.shipped = values[-1][3]
                self.new += steps
            self._offset, self._last_line = offset, last_line
        self._ship_samples()

    def close(self, final):
        """Log a `spool.Final`, unless MLflow has it."""
        if self.closed(final):
            return
        values = [(key, float(value), final.milliseconds, self.shipped) for key, value in _numbers(final.metrics)]
        for first in range(0, len(values), BATCH):
            self._send(values[first : first + BATCH])
        for name in final.files:
            self._log_file(name)
            if Path(name).name == NOTE:
                text = (self._spec.folder / name).read_text()
                self._client.set_tag(self.run_id, "mlflow.note.content", text[:LONGEST_TAG])
        if final.model:
            model_registry.ship(self._client, *self._experiment, self.run_id, values, self.shipped, self._spec)
        self._client.set_terminated(self.run_id, final.status, final.milliseconds)

    def closed(self, final):
        """Whether all of a `spool.Final` is in MLflow."""
        info = self._client.get_run(self.run_id).info
        return (info.status, info.end_time) == (final.status, final.milliseconds)

    def _log_file(self, name):
        """Log a file or folder at the place that it has in the run's folder. What is not there any more is left out."""
        path, place = self._spec.folder / name, Path(name)
        if place.is_absolute():  # of another folder
            place = Path(place.name)
        if path.is_dir():
            self._client.log_artifacts(self.run_id, str(path), place.as_posix())
        elif path.exists():
            self._client.log_artifact(self.run_id, str(path), place.parent.as_posix().lstrip(".") or None)

    def _ship_samples(self):
        path, offset = spool.system_path(self._spec.folder), spool.read_system(self._spec.folder, self.run_id)
        data = path.read_bytes()[offset:] if path.exists() else b""
        lines = data[: data.rfind(b"\n") + 1].splitlines(keepends=True)
        values, sent = [], offset
        for raw in lines:
            line = json.loads(raw)
            new = [(key, value, line["milliseconds"], line["step"]) for key, value in line["metrics"].items()]
            if values and len(values) + len(new) > BATCH:
                self._send(values)
                spool.record_system(self._spec.folder, self.run_id, sent)
                values = []
            values, sent = values + new, sent + len(raw)
        if values:
            self._send(values)
            spool.record_system(self._spec.folder, self.run_id, sent)

    def _send(self, values):
        from mlflow.entities import Metric

        self._client.log_batch(self.run_id, metrics=[Metric(*value) for value in values])

    def _next_batch(self, path):
        """(values, offset behind them, last line read, number of steps) of the next whole lines that fit in a batch.

        None if there are none. Steps that MLflow has are skipped. values: [(key, value, milliseconds, step)].
        """
        values, last, steps = [], self.shipped, 0
        with open(path, "rb") as file:
            offset, line = self._continue(file)
            start = offset
            for raw in file:
                if not raw.endswith(b"\n"):
                    break
                content = json.loads(raw)
                step = int(content["iteration"])
                if step > last:
                    clock = int(1000 * content["perf/time"])
                    new = [(key, float(value), clock, step) for key, value in _numbers(content) if key != "iteration"]
                    new.append(("iteration", float(step), clock, step))
                    if values and len(values) + len(new) > BATCH:
                        break
                    values += new
                    last, steps = step, steps + 1
                offset, line = offset + len(raw), raw
        return (values, offset, line, steps) if offset > start else None

    def _continue(self, file):
        """Go to where the last batch ended, or to the start if the file was cut back and written anew since then."""
        file.seek(max(self._offset - len(self._last_line), 0))
        if file.read(len(self._last_line)) == self._last_line:
            return self._offset, self._last_line
        file.seek(0)
        return 0, b""


def _numbers(metrics):
    """(key, value) of what MLflow can hold."""
    return [(k, v) for k, v in metrics.items() if isinstance(v, (int, float)) and math.isfinite(v)]
