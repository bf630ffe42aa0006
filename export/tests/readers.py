"""Reads what `cz export` has written with other people's readers and says, as JSON, what is in it.

    python readers.py FORMAT PATH

Exit code 3: a reader is not installed; the last line of stderr says which.
"""

import json
import sys
from pathlib import Path


def need(module):
    """Imports a module by its dotted name."""
    try:
        __import__(module)
    except ImportError as error:
        print(error, file=sys.stderr)
        sys.exit(3)
    return sys.modules[module]


def validate(path, schema, own=()):
    """Whether a file keeps SUMO's XML schema once our own attributes are taken out; `None` where SUMO ships none."""
    etree = need("lxml.etree")
    file = Path(need("sumo").SUMO_HOME) / "data" / "xsd" / schema
    if not file.exists():
        return None
    tree = etree.parse(str(path))
    for element in tree.iter():
        for name in own:
            element.attrib.pop(name, None)
    validator = etree.XMLSchema(etree.parse(str(file)))
    return "" if validator.validate(tree) else str(validator.error_log)


def sumo_tool(tool, *arguments):
    """What a tool of SUMO's own says."""
    import os
    import subprocess

    home = Path(need("sumo").SUMO_HOME)
    environment = dict(os.environ, SUMO_HOME=str(home))
    command = [sys.executable, str(home / "tools" / tool), *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    if done.returncode != 0:
        raise SystemExit(done.stderr)
    return done.stdout


def fcd(path):
    xml = need("sumolib").xml
    dt_s, last, energy, vehicles, lanes = None, None, 0.0, set(), set()
    steps = 0
    for step in xml.parse(str(path), "timestep"):
        time_s = float(step.time)
        dt_s = dt_s or (time_s - last if last is not None else None)
        last = time_s
        steps += 1
        for vehicle in step.vehicle or []:
            vehicles.add(vehicle.id)
            lanes.add(vehicle.lane)
            energy += 0.5 * float(vehicle.acceleration) ** 2
    table = path.with_suffix(".csv")
    sumo_tool("xml/xml2csv.py", path, "-o", table)
    lines = sum(1 for _ in open(table))
    invalid = validate(path, "fcd_file.xsd")
    return {"steps": steps, "vehicles": len(vehicles), "energy": energy * dt_s, "lanes": sorted(lanes),
            "lines_of_xml2csv": lines, "invalid": invalid}


def tripinfo(path):
    trips = list(need("sumolib").xml.parse(str(path), "tripinfo"))
    said = sumo_tool("output/attributeStats.py", path, "-a", "duration")
    return {"vehicles": len(trips), "energy": sum(float(trip.energy) for trip in trips),
            "arrived": sum(float(trip.arrival) >= 0 for trip in trips),
            "duration": sum(float(trip.duration) for trip in trips),
            "stats": said, "invalid": validate(path, "tripinfo_file.xsd", ["energy", "feTime"])}


def ssm(path):
    conflicts = list(need("sumolib").xml.parse(str(path), "conflict"))
    times = [float(c.minTTC[0].value) for c in conflicts if c.minTTC[0].value != "NA"]
    spans = [(len(c.timeSpan[0].values.split()), len(c.TTCSpan[0].values.split())) for c in conflicts]
    return {"conflicts": len(conflicts), "pairs": sorted({(c.ego, c.foe) for c in conflicts}),
            "min_ttc": min(times, default=None), "spans_agree": all(a == b for a, b in spans)}


def csv(path):
    polars = need("polars")
    read = lambda name: polars.read_csv(path / f"{name}.csv", infer_schema_length=None)
    return summary_of({name: read(name).to_dicts() for name in ("states", "visits", "vehicles", "events")})


def parquet(path):
    tables = need("pyarrow.parquet")
    read = lambda name: tables.read_table(path / f"{name}.parquet")
    schema = tables.read_schema(path / "states.parquet")
    units = {field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in schema}
    said = summary_of({name: read(name).to_pylist() for name in ("states", "visits", "vehicles", "events")})
    rows = {name: read(name).num_rows for name in ("commands", "assignments", "summaries", "run")}
    described = all(field.metadata and field.metadata.get(b"description") for field in schema)
    return said | {"units": units, "rows": rows, "described": described}


def summary_of(tables):
    return {"vehicles": len(tables["vehicles"]), "seen": len({row["vehicle"] for row in tables["states"]}),
            "steps": len({row["step"] for row in tables["states"]}),
            "energy": sum(row["energy"] for row in tables["visits"]),
            "energy_of_vehicles": sum(row["energy"] for row in tables["vehicles"]),
            "visits": len(tables["visits"]), "departed": sum(row["kind"] == "departed" for row in tables["events"])}


def mcap(path):
    reader_module, jsonschema = need("mcap.reader"), need("jsonschema")
    topics, vehicles, energy, lengths, invalid, positions = {}, set(), 0.0, set(), [], []
    with open(path, "rb") as file:
        reader = reader_module.make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            value = json.loads(message.data)
            count = topics.setdefault(channel.topic, [schema.name, schema.encoding, 0])
            count[2] += 1
            # The schema is large: the first few of each topic.
            if count[2] <= 3:
                try:
                    jsonschema.validate(value, json.loads(schema.data))
                except jsonschema.ValidationError as error:
                    invalid.append(f"{channel.topic}: {error.message}")
            if channel.topic == "/scene":
                for entity in value["entities"]:
                    vehicles.add(entity["id"])
                    lengths.add(entity["cubes"][0]["size"]["x"])
            if channel.topic == "/visits":
                energy += value["energy"]
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    return {"topics": topics, "vehicles": len(vehicles), "lengths": sorted(lengths), "energy": energy,
            "invalid": invalid, "run": metadata.get("run")}


def perfetto(path):
    messages = need("perfetto.protos.perfetto.trace.perfetto_trace_pb2")
    trace = messages.Trace()
    trace.ParseFromString(path.read_bytes())
    event = messages.TrackEvent
    tracks, depth, visits, energy, late = {}, {}, set(), 0.0, {}
    wrong, counters, inner = [], 0, 0
    for packet in trace.packet:
        if packet.HasField("track_descriptor"):
            tracks[packet.track_descriptor.uuid] = packet.track_descriptor
            continue
        what = packet.track_event
        if what.track_uuid not in tracks:
            wrong.append(f"no track {what.track_uuid}")
        if packet.timestamp < late.get(what.track_uuid, 0):
            wrong.append(f"track {what.track_uuid} goes back")
        late[what.track_uuid] = packet.timestamp
        if what.type == event.TYPE_SLICE_BEGIN:
            depth[what.track_uuid] = depth.get(what.track_uuid, 0) + 1
            inner += depth[what.track_uuid] > 1
            notes = {note.name: note for note in what.debug_annotations}
            if "visit" in what.categories:
                visits.add(notes["vehicle"].uint_value)
                energy += notes["energy"].double_value
        elif what.type == event.TYPE_SLICE_END:
            depth[what.track_uuid] -= 1
        elif what.type == event.TYPE_COUNTER:
            counters += tracks[what.track_uuid].HasField("counter")
    return {"vehicles": len(visits), "energy": energy, "wrong": wrong, "open": sum(depth.values()),
            "counters": counters, "inner": inner}


def processes(path):
    """What `cz run --trace` writes, by Perfetto's own trace processor, which its package fetches when it is first used."""
    need("perfetto.trace_processor")
    from perfetto.trace_processor import TraceProcessor
    try:
        processor = TraceProcessor(trace=str(path))
    except Exception as error:
        print(f"no trace processor: {error}", file=sys.stderr)
        sys.exit(3)
    spans = "select process.name as process, slice.name as name, count(*) as spans, sum(slice.dur) as dur from slice " \
        "join thread_track on slice.track_id = thread_track.id join thread using (utid) join process using (upid) " \
        "where slice.dur > 0 group by 1, 2"
    lost = "select sum(value) as lost from stats where severity in ('error', 'data_loss')"
    return {"spans": {f"{row.process}: {row.name}": row.spans for row in processor.query(spans)},
            "lost": next(iter(processor.query(lost))).lost or 0}


if __name__ == "__main__":
    print(json.dumps(globals()[sys.argv[1]](Path(sys.argv[2]))))
