// SPDX-License-Identifier: Apache-2.0
// Read a solution.mcap with the libraries of Foxglove and Lichtblick:
//   npm install @mcap/core @mcap/nodejs @mcap/support @foxglove/rosmsg @foxglove/rosmsg2-serialization
//     @foxglove/rosmsg-msgs-common @foxglove/schemas
//   node viewers.mjs OUT/DIVE/solution.mcap
// Prints one JSON object: the topics with their type and number of messages, all decoded; and the types whose
// definition differs from the viewers' own.
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { ros2jazzy } from "@foxglove/rosmsg-msgs-common";
import { foxgloveMessageSchemas, generateRosMsg, generateRosMsgDefinition } from "@foxglove/schemas/internal.js";

const file = await open(process.argv[2]);
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(file),
  decompressHandlers: await loadDecompressHandlers(),
});
const short = (type) => type.replace("/msg/", "/");
const fields = (definition) =>
  definition.definitions
    .filter((f) => !f.isConstant)
    .map((f) => `${short(f.type)}${f.isArray ? `[${f.arrayLength ?? ""}]` : ""} ${f.name}`);
const theirs = new Map(Object.entries(ros2jazzy).map(([k, v]) => [short(v.name ?? k), fields(v)]));
const geo = generateRosMsg(generateRosMsgDefinition(foxgloveMessageSchemas.GeoJSON, { rosVersion: 2 }), { rosVersion: 2 });
theirs.set("foxglove_msgs/GeoJSON", fields(parse(geo, { ros2: true })[0]));
const readers = new Map(), differing = {}, unknown = new Set(), compared = new Set();
for (const [id, schema] of reader.schemasById) {
  const parsed = parse(new TextDecoder().decode(schema.data), { ros2: true });
  readers.set(id, new MessageReader(parsed));
  for (const part of parsed) {
    const name = short(part.name ?? schema.name);
    const own = theirs.get(name);
    if (!own) unknown.add(name);
    else { compared.add(name); if (JSON.stringify(own) !== JSON.stringify(fields(part))) differing[name] = [own, fields(part)]; }
  }
}
const topics = {};
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const decoded = readers.get(channel.schemaId).readMessage(message.data);
  const topic = (topics[channel.topic] ??= { type: reader.schemasById.get(channel.schemaId).name, messages: 0 });
  topic.messages += Object.keys(decoded).length > 0;
}
const definitions = Object.fromEntries([...compared].sort().map((name) => [name, theirs.get(name)]));
console.log(JSON.stringify({ topics, unknown: [...unknown].sort(), differing, definitions }, null, 1));
