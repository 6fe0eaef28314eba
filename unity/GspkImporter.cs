// Example: reads a .gspk (docs/formats/gspk.md) in Unity and hands its streams to GPU buffers.
//
// NOT RUN HERE: this file was written from the specification and has been neither compiled nor run. It needs Unity 2022.3 or
// newer with Newtonsoft.Json (com.unity.nuget.newtonsoft-json). It reads streams stored with codec "none"
// (gsplat-convert ... --codec none, or save(..., codec="none")); for "zstd" put a decoder in Decompress.
//
// gsplat-unity's shaders have Spark's default ranges built in: a file written with --spark-encoding fit is refused here.
// Axes: Unity is RUF; convert with --target-coordinates RUF.

using System;
using System.Collections.Generic;
using System.IO;
using System.Linq;
using System.Text;
using Newtonsoft.Json.Linq;
using UnityEngine;

namespace GsplatTools
{
    /// <summary>The streams of a .gspk as GPU buffers, and what its description says.</summary>
    public sealed class GspkFile : IDisposable
    {
        const int HeaderBytes = 64;

        public JObject Description { get; private set; }
        public string Layout => (string)Description["layout"];
        public int Count => (int)Description["count"];
        public int Degree => (int)Description["degree"];

        /// <summary>Box of the positions as stored; world position = origin + stored position.</summary>
        public Bounds Bounds { get; private set; }

        /// <summary>One buffer a stream, by name: packed, sh1.. or positions, colors, scales, rotations, shs.</summary>
        public Dictionary<string, GraphicsBuffer> Buffers { get; } = new Dictionary<string, GraphicsBuffer>();

        public static GspkFile Load(string path)
        {
            using (var stream = File.OpenRead(path))
            {
                var file = new GspkFile();
                try
                {
                    file.Read(stream);
                    return file;
                }
                catch
                {
                    file.Dispose();
                    throw;
                }
            }
        }

        void Read(Stream stream)
        {
            byte[] header = ReadExactly(stream, 0, HeaderBytes);
            if (Encoding.ASCII.GetString(header, 0, 4) != "GSPK") throw new InvalidDataException("not a .gspk: wrong magic");
            uint version = BitConverter.ToUInt32(header, 4);
            if (version != 1) throw new InvalidDataException($"version {version} is not known, 1 is");
            long length = checked((long)BitConverter.ToUInt64(header, 8));
            if (length != stream.Length) throw new InvalidDataException($"the header says {length} bytes, the file has {stream.Length}");
            long jsonOffset = checked((long)BitConverter.ToUInt64(header, 16));
            long jsonLength = checked((long)BitConverter.ToUInt64(header, 24));
            byte[] text = ReadExactly(stream, jsonOffset, checked((int)jsonLength));
            if (Crc32(text) != BitConverter.ToUInt32(header, 32)) throw new InvalidDataException("the description's checksum differs");
            Description = JObject.Parse(Encoding.UTF8.GetString(text));

            if (Layout == "spark") RefuseOtherRanges();
            if (Description["bounds"] is JObject box)
            {
                Vector3 low = ToVector(box["min"]), high = ToVector(box["max"]);
                Bounds = new Bounds((low + high) / 2, high - low);
            }
            foreach (JToken entry in (JArray)Description["streams"]) ReadStream(stream, (JObject)entry);
        }

        void ReadStream(Stream stream, JObject entry)
        {
            long offset = (long)entry["offset"], raw = (long)entry["raw_length"];
            int[] shape = ((JArray)entry["shape"]).Select(size => (int)size).ToArray();
            if (shape[0] == 0) return;
            int rowBytes = 4 * shape.Skip(1).Aggregate(1, (product, size) => product * size);
            if (shape[0] != Count || raw != (long)Count * rowBytes) throw new InvalidDataException($"{entry["name"]}: shape and length differ");

            var buffer = new GraphicsBuffer(GraphicsBuffer.Target.Structured, checked((int)(raw / 4)), 4);
            Buffers.Add((string)entry["name"], buffer);
            int frameRows = (int)Description["frame_rows"], start = 0;
            JArray lengths = (JArray)entry["frames"], checksums = (JArray)entry["crc32"];
            for (int i = 0; i < lengths.Count; i++)
            {
                int rows = Math.Min(frameRows, Count - start);
                byte[] data = ReadExactly(stream, offset, (int)lengths[i]);
                if ((string)entry["codec"] != "none") data = Decompress(data, rows * rowBytes);
                if (data.Length != rows * rowBytes || Crc32(data) != (uint)checksums[i]) throw new InvalidDataException($"{entry["name"]}: frame {i} is damaged");
                buffer.SetData(data, 0, start * rowBytes, data.Length);
                offset += (long)lengths[i];
                start += rows;
            }
        }

        static byte[] Decompress(byte[] stored, int rawLength) =>
            throw new NotSupportedException("streams are stored with zstd: write the file with codec none, or call a Zstandard decoder here");

        void RefuseOtherRanges()
        {
            var defaults = new Dictionary<string, double>
            {
                { "rgbMin", 0 }, { "rgbMax", 1 }, { "lnScaleMin", -12 }, { "lnScaleMax", 9 },
                { "sh1Max", 1 }, { "sh2Max", 1 }, { "sh3Max", 1 }, { "sh4Max", 1 },
            };
            if (!(Description["splat_encoding"] is JObject ranges)) return;
            foreach (var range in defaults)
            {
                JToken value = ranges[range.Key];
                if (value != null && (double)value != range.Value) throw new NotSupportedException($"{range.Key} is {value}: gsplat-unity has {range.Value} built in");
            }
        }

        static Vector3 ToVector(JToken values) => new Vector3((float)values[0], (float)values[1], (float)values[2]);

        static byte[] ReadExactly(Stream stream, long offset, int count)
        {
            var data = new byte[count];
            stream.Seek(offset, SeekOrigin.Begin);
            for (int done = 0; done < count;)
            {
                int read = stream.Read(data, done, count - done);
                if (read == 0) throw new EndOfStreamException($"{count} bytes at {offset} are not there");
                done += read;
            }
            return data;
        }

        static readonly uint[] CrcTable = Enumerable.Range(0, 256).Select(i =>
        {
            uint value = (uint)i;
            for (int bit = 0; bit < 8; bit++) value = (value & 1) != 0 ? 0xEDB88320u ^ (value >> 1) : value >> 1;
            return value;
        }).ToArray();

        static uint Crc32(byte[] data)
        {
            uint value = 0xFFFFFFFFu;
            foreach (byte b in data) value = CrcTable[(value ^ b) & 255] ^ (value >> 8);
            return ~value;
        }

        public void Dispose()
        {
            foreach (GraphicsBuffer buffer in Buffers.Values) buffer.Release();
            Buffers.Clear();
        }
    }
}
