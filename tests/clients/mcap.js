// Reads a log as any user of @mcap/core does, and prints what is in it as JSON.
"use strict";
const fs = require("node:fs");
const { McapStreamReader } = require("@mcap/core");
const { decompress } = require("fzstd");
const protobuf = require("protobufjs");
require("protobufjs/ext/descriptor");

const reader = new McapStreamReader({
  validateCrcs: true,
  decompressHandlers: { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) },
});
reader.append(fs.readFileSync(process.argv[2]));
const schemas = new Map(), channels = new Map();
const found = { topics: {}, attachments: [], metadata: [], positions: [], events: [] };
for (let record; (record = reader.nextRecord());) {
  if (record.type === "Schema" && record.encoding === "protobuf") {
    schemas.set(record.id, protobuf.Root.fromDescriptor(record.data).lookupType(record.name));
  } else if (record.type === "Channel") {
    channels.set(record.id, record);
  } else if (record.type === "Attachment") {
    found.attachments.push(record.name);
  } else if (record.type === "Metadata") {
    found.metadata.push(record.name);
  } else if (record.type === "Message") {
    const { topic, schemaId } = channels.get(record.channelId);
    found.topics[topic] = (found.topics[topic] || 0) + 1;
    const message = schemas.has(schemaId) ? schemas.get(schemaId).decode(record.data) : null;
    if (topic === "/axis/tick") found.positions.push(message.measurement.position_m);
    if (topic === "/events") found.events.push(message.message);
  }
}
found.done = reader.done();
console.log(JSON.stringify(found));
