// A viewer: looks at everything for some seconds, tries to change a parameter, prints what it saw as JSON.
"use strict";
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const WebSocket = require("ws");
const protobuf = require("protobufjs");
require("protobufjs/ext/descriptor");

const [url, seconds] = [process.argv[2], Number(process.argv[3])];
const found = { topics: {}, samples: [], events: [], frames: 0, parameters: 0, before: null, after: null };
const types = new Map();

const connect = attempts => {
  const socket = new WebSocket(url, ["foxglove.sdk.v1"]);
  socket.once("error", () => {
    if (attempts === 0) { console.error("nobody serves at " + url); process.exit(1); }
    setTimeout(() => connect(attempts - 1), 100);
  });
  socket.once("open", () => { socket.removeAllListeners("error"); });
  const client = new FoxgloveClient({ ws: socket });
  client.on("error", () => {});
  client.on("advertise", channels => {
    for (const channel of channels) {
      const root = protobuf.Root.fromDescriptor(Buffer.from(channel.schema, "base64"));
      types.set(client.subscribe(channel.id), [channel.topic, root.lookupType(channel.schemaName)]);
      found.topics[channel.topic] = channel.schemaName;
    }
    client.getParameters([], "all");
  });
  client.on("message", ({ subscriptionId, data }) => {
    const [topic, type] = types.get(subscriptionId);
    const message = type.decode(new Uint8Array(data.buffer, data.byteOffset, data.byteLength));
    if (topic === "/axis/tick") found.samples.push([Number(message.t_ns), message.measurement.position_m]);
    else if (topic === "/events") found.events.push(message.message);
    else found.frames += message.received.length;
  });
  client.on("parameterValues", ({ parameters, id }) => {
    const one = parameters.find(p => p.name === "control.k1");
    if (id === "all") {
      found.parameters = parameters.length;
      found.before = one.value;
      client.setParameters([{ name: "control.k1", value: 1.0 }], "set");
    } else found.after = one.value;
  });
  socket.once("open", () => setTimeout(() => {
    process.stdout.write(JSON.stringify(found) + "\n", () => process.exit(0));
  }, 1000 * seconds));
};
connect(100);
