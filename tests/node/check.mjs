// Reads each file with index and as a stream, checksums compared; prints how many messages there are, a line for each.
import { readFileSync } from "node:fs";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { decompress } from "fzstd";
const decompressHandlers = { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) };
for (const path of process.argv.slice(2)) {
  const bytes = new Uint8Array(readFileSync(path));
  const readable = {
    size: async () => BigInt(bytes.length),
    read: async (offset, length) => bytes.subarray(Number(offset), Number(offset + length)),
  };
  const counts = {};
  const indexed = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const topics = new Map([...indexed.channelsById.values()].map((c) => [c.id, c.topic]));
  let last = 0n;
  for await (const message of indexed.readMessages()) {
    if (message.logTime < last) throw new Error("messages out of order");
    last = message.logTime;
    const topic = topics.get(message.channelId);
    counts[topic] = (counts[topic] ?? 0) + 1;
  }
  let streamed = 0;
  const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  stream.append(bytes);
  for (let record; (record = stream.nextRecord()); ) if (record.type === "Message") streamed++;
  if (!stream.done()) throw new Error("the stream does not end");
  console.log(JSON.stringify({ counts, streamed }));
}
